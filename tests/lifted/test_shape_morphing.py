"""Looks along a path: where they are shown, and parts that pose and stretch as meshes do."""

import numpy as np
import pytest
import torch
import trimesh
from parts_of_rooms import CORNER, TABLE

from sceneprior.core.parts import filled_cells
from sceneprior.core.views import DecodedScenes
from sceneprior.lifted.prototype_decoder import PosedScenes, PrototypeConfig, PrototypeDecoder
from sceneprior.lifted.prototypes import Prototypes
from sceneprior.lifted.shape_morphing import appearances_of

STEPS = 129


@pytest.fixture
def decoder() -> PrototypeDecoder:
    """Two prototypes, a corner and a table."""
    decoder = PrototypeConfig(prototypes=2, codes=8, cells=16).build(6)
    parts = (CORNER, TABLE)
    grids = np.stack([filled_cells(each, 16, 1.1) for each in parts])
    sizes_m = np.array([[2.0, 0.5, 1.0], [1.0, 0.8, 0.6]])
    decoder.set_prototypes(Prototypes(parts, grids, sizes_m, np.array([1, 2]), np.ones(2, bool)))
    return decoder


def test_looks_are_shown_at_the_ends_and_in_the_middle_of_where_they_hold():
    looks = np.repeat([5, 7, 9, 7], [33, 32, 8, 56])
    (shown,) = appearances_of(looks, np.ones(STEPS, bool))
    assert shown.looks.tolist() == [5, 7, 7]  # 9 holds for a sixteenth of the path
    np.testing.assert_allclose(shown.places, [0, 48.5 / 128, 1])
    assert shown.at(0.0) == (5, 5, 0.0) or shown.at(0.0) == (5, 7, 0.0)
    assert shown.at(48.5 / 256) == (5, 7, 0.5)
    assert shown.at(0.7) == (7, 7, 0.0) and shown.at(1.0) == (7, 7, 0.0)


def test_an_object_that_comes_and_goes_has_its_own_looks_each_time():
    kept = np.zeros(STEPS, bool)
    kept[[*range(10, 51), *range(90, 129)]] = True
    looks = np.where(np.arange(STEPS) < 30, 1, 2)
    first, second = appearances_of(looks, kept)
    assert first.looks.tolist() == [1, 2] and second.looks.tolist() == [2, 2]
    np.testing.assert_allclose(first.places, [10 / 128, 50 / 128])
    assert first.apart(0.0) == 10 / 128 and first.apart(0.2) == 0
    assert appearances_of(looks, np.zeros(STEPS, bool)) == []
    (once,) = appearances_of(looks, np.arange(STEPS) == 10)
    assert once.at(10 / 128) == (1, 1, 0.0)


def decoded(looks) -> DecodedScenes:
    """Rooms of one object, which has these looks."""
    rooms = len(looks)
    return PosedScenes(
        torch.zeros(rooms, 1, 3), torch.zeros(rooms, 1, 3), torch.ones(rooms, 1, 3),
        torch.ones(rooms, 1), looks=torch.tensor(looks).unsqueeze(1),
    )  # fmt: skip


def test_shapes_are_the_decoded_ones_at_the_ends_and_change_between(decoder):
    looks = [3] * 65 + [12] * 64
    path, some = decoded(looks), decoded([looks[0], looks[20], looks[80], looks[-1]])
    places = torch.tensor([0.0, 20 / 128, 80 / 128, 1.0], dtype=torch.float64)
    rooms = decoder.along_path(some, places, path, torch.ones(STEPS, 1, dtype=torch.bool))
    for room in (0, 3):
        there, here = decoder.mesh_of(some, room, 0), decoder.mesh_of(rooms, room, 0)
        np.testing.assert_array_equal(here.vertices_m, there.vertices_m)
        assert decoder.solids_of(rooms, room, 0) == decoder.solids_of(some, room, 0)
    for room in (1, 2):
        mesh = decoder.mesh_of(rooms, room, 0)
        here = trimesh.Trimesh(mesh.vertices_m, mesh.faces)
        assert here.is_watertight
        bounds = np.array([here.bounds, [[-0.5] * 3, [0.5] * 3]])
        np.testing.assert_allclose(*bounds, atol=2e-3)
        solids = decoder.solids_of(rooms, room, 0)
        union = trimesh.boolean.union([trimesh.creation.box(bounds=each[1:]) for each in solids])
        assert union.volume == pytest.approx(here.volume, rel=0.02)
    bare = decoded(looks[:2])
    no_looks = DecodedScenes(*(getattr(bare, name) for name in (
        "class_logits", "centers_m", "sizes_m", "completeness_logits")))  # fmt: skip
    assert decoder.along_path(no_looks, places[:2], no_looks, torch.ones(2, 1) > 0) is no_looks

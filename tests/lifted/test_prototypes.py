"""Prototypes and looks: what looks alike in some pose is one, codes, decoded meshes and turns."""

import numpy as np
import pytest
import torch
import trimesh
from parts_of_rooms import CORNER, boxes
from rooms_of_boxes import CELLS

from sceneprior.core.boxes import turn_grids
from sceneprior.core.colliders import mesh_of
from sceneprior.core.parts import SQUARE, Parts, filled_cells
from sceneprior.lifted import prototype_decoder, prototypes
from sceneprior.lifted.prototype_decoder import PrototypeConfig
from sceneprior.lifted.prototypes import (
    POSES,
    Prototypes,
    choose_prototypes,
    embed_posed,
    pooled,
    pose_distances,
    turn_of,
    turn_posed,
    turned_extents,
)

RNG = np.random.default_rng(0)
# Nothing in common with itself mirrored or turned.
ODD = RNG.random((CELLS,) * 3) < 0.5
SIZE = np.array([2.0, 0.5, 1.0])


def in_poses() -> tuple[np.ndarray, np.ndarray]:
    grids = np.concatenate([turn_grids(ODD[None], *turn_of(pose)) for pose in range(POSES)])
    return grids, np.concatenate([turned_extents(SIZE[None], pose) for pose in range(POSES)])


def test_one_object_in_all_its_poses_is_one_prototype():
    grids, sizes = in_poses()
    labels, usable = np.ones(POSES, dtype=np.int64), np.ones(POSES, dtype=bool)
    items, common = choose_prototypes(grids, sizes, labels, usable, most=99)
    assert items.tolist() == [0] and common.tolist() == [True]
    nothing = boxes((0, 64, 0, 64, 0, 64))
    shown = Prototypes((nothing,), grids[:1], sizes[:1], labels[:1], common).shown()
    for pose in range(POSES):
        assert np.allclose(shown[pose][-3:], np.log(sizes[pose]))
        assert np.allclose(shown[pose][:-3], pooled(grids[pose : pose + 1], 4).ravel())


def test_prototypes_do_not_depend_on_the_blocks_of_distances(monkeypatch):
    rng = np.random.default_rng(1)
    kinds = rng.random((3, CELLS, CELLS, CELLS)) < 0.5
    of, labels = rng.integers(3, size=12), rng.integers(1, 3, size=12)
    grids = kinds[of] ^ (rng.random((12, CELLS, CELLS, CELLS)) < 0.02)
    given = grids, rng.uniform(0.9, 1.1, (12, 3)), labels, np.arange(12) != 5, 99
    whole = choose_prototypes(*given)
    monkeypatch.setattr(prototypes, "BLOCK", 2)
    for found, wanted in zip(choose_prototypes(*given), whole, strict=True):
        assert found.tolist() == wanted.tolist()
    assert 5 <= len(whole[0]) <= 6 and whole[1].any()


def test_distances_are_those_of_a_loop():
    grids = RNG.random((3, CELLS, CELLS, CELLS)) < 0.5
    sizes = RNG.uniform(0.3, 2, (3, 3))
    ours = pose_distances((grids, sizes), (grids[:2], sizes[:2]))
    for a in range(3):
        for b in range(2):
            each = []
            for way in range(POSES):
                there = pooled(turn_grids(grids[b : b + 1], *turn_of(way)), 8)[0]
                differ = np.log(sizes[a]) - np.log(turned_extents(sizes[b : b + 1], way)[0])
                here = pooled(grids[a : a + 1], 8)[0]
                relative = ((here - there) ** 2).sum() / np.sqrt(here.sum() * there.sum())
                each.append(relative + 0.3 * np.abs(differ).sum())
            assert ours[a, b] == pytest.approx(each, abs=1e-6)


@pytest.mark.parametrize("codes", [3, 40])
def test_codes_are_as_far_apart_as_the_grids_of_looks(codes):
    grids = RNG.random((4, CELLS, CELLS, CELLS)) < 0.5
    found = embed_posed(grids, codes)
    flat = np.concatenate(
        [
            turn_grids(grid[None], *turn_of(pose)).reshape(1, -1)
            for grid in grids
            for pose in range(8)
        ]
    )
    apart, wanted = (
        ((each[:, None] - each[None]) ** 2).sum(axis=-1)
        for each in (found, flat.astype(np.float64))
    )
    if codes == 40:  # 32 looks: nothing is left out
        np.testing.assert_allclose(apart, wanted, rtol=0, atol=0.01)
        assert not found[:, 31:].round(3).any()
    else:  # the most that so few numbers can say
        centred = flat - flat.mean(axis=0)
        kept = (np.linalg.svd(centred, compute_uv=False)[:codes] ** 2).sum()
        assert (found**2).sum() == pytest.approx(kept, rel=1e-4)
        assert (apart < wanted + 0.01).all()


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("quarters", range(4))
def test_looks_turn_as_grids_do(quarters, mirrored):
    looks = torch.arange(POSES)[None] + 3 * POSES
    turned = turn_posed(looks, torch.tensor([quarters]), torch.tensor([mirrored]))[0]
    assert (turned // POSES == 3).all()
    for pose, after in enumerate((turned % POSES).tolist()):
        here = turn_grids(ODD[None], *turn_of(pose))
        there = turn_grids(here, quarters, mirrored)
        assert np.array_equal(turn_grids(ODD[None], *turn_of(after)), there)


def test_an_object_has_the_look_whose_code_is_nearest(torch_rng):
    later = Parts(*(part[1:] for part in CORNER[:3]), SQUARE.clip(max=[0.25, 0.5]))
    parts = (CORNER, CORNER._replace(ends=CORNER.ends * 0.8), later)  # without symmetry
    grids = np.stack([filled_cells(each, 8, 1.1) for each in parts])
    sizes_m = np.random.default_rng(0).uniform(0.5, 2, (3, 3))
    decoder = PrototypeConfig(prototypes=5, codes=30, width=8, cells=8).build(6)
    assert decoder.known == [] and decoder.looks(torch.zeros(2, 30)).tolist() == [0, 0]
    labels, common = np.array([2, 1, 2]), np.array([True, True, False])
    decoder.set_prototypes(Prototypes(parts, grids, sizes_m, labels, common))
    looks = torch.arange(3 * POSES)
    codes, cells = decoder.targets(looks)
    assert torch.equal(decoder.looks(codes), looks)
    # Half a look's way to its neighbour is still its own; beyond that it is the neighbour.
    assert torch.equal(decoder.looks(torch.lerp(codes[:-1], codes[1:], 0.4)), looks[:-1])
    assert torch.equal(decoder.looks(torch.lerp(codes[:-1], codes[1:], 0.6)), looks[1:])
    some = 3 * torch.randn(2, 4, 30, generator=torch_rng)
    slow = ((some.unsqueeze(2) - codes) ** 2).sum(dim=-1).argmin(dim=-1)
    assert torch.equal(decoder.looks(some), slow)  # never one of those that are none
    assert torch.equal(cells, decoder.filled[looks // POSES]) and (cells > 20).all()


def test_meshes_and_solids_turn_and_fill_boxes_as_grids_do(monkeypatch):
    """On a shape without symmetry: a look's mesh against the cells of its turned grid, and the
    union of its solids against the mesh. Of the looks, few are kept: `view` runs for days."""
    monkeypatch.setattr(prototype_decoder, "KEPT", 3)
    decoder = PrototypeConfig(prototypes=2, codes=8, cells=32, margin=1.0).build(6)
    grids = filled_cells(CORNER, 32, 1.0)[None]
    size_m = np.array([[2.0, 0.5, 1.0]])
    decoder.set_prototypes(Prototypes((CORNER,), grids, size_m, np.array([1]), np.ones(1, bool)))
    center_m = np.random.default_rng(0).normal(size=3)
    middles = (np.arange(32) + 0.5) / 32 - 0.5
    points = np.stack(np.meshgrid(middles, middles, middles, indexing="ij"), axis=-1)
    for pose in range(POSES):
        own_m = turned_extents(size_m, pose)[0]
        box = np.array([*center_m, *own_m])
        mesh = decoder.mesh(pose, box)
        assert len(decoder._shapes) <= 3
        here = trimesh.Trimesh(mesh.vertices_m, mesh.faces)
        assert here.is_volume
        turned = turn_grids(grids, *turn_of(pose))[0]
        assert here.volume == pytest.approx(turned.mean() * own_m.prod(), rel=0.02)
        middle_m = points[turned].mean(axis=0) * own_m + center_m
        np.testing.assert_allclose(here.center_mass, middle_m, atol=0.01)
        parts = [mesh_of(each) for each in decoder.solids(pose, box)]
        union = trimesh.boolean.union([trimesh.Trimesh(p.vertices_m, p.faces) for p in parts])
        assert union.volume == pytest.approx(here.volume, rel=0.01)
        np.testing.assert_allclose(union.center_mass, here.center_mass, atol=0.01)

"""Looks: prototypes in parts, their codes, and how the prior decodes them."""

import numpy as np
import pytest
import torch
import trimesh
from parts_of_rooms import CORNER
from tiny_runs import tiny_lifted

from sceneprior.core.boxes import turn_grids
from sceneprior.core.colliders import mesh_of
from sceneprior.core.parts import SQUARE, Parts, filled_cells
from sceneprior.lifted.prototype_decoder import PrototypeConfig, PrototypeDecoder
from sceneprior.lifted.prototypes import POSES, Prototypes, turn_of, turned_extents
from sceneprior.paper.prior import ScenePrior

SMALL = {"prototypes": 9, "codes": 4, "width": 8, "cells": 8, "margin": 1.2}


@pytest.fixture
def prior(tmp_path) -> ScenePrior:
    return tiny_lifted(tmp_path, model__shape=SMALL).build_prior()


@pytest.fixture
def prototypes() -> Prototypes:
    """Three shapes without symmetry."""
    rng = np.random.default_rng(0)
    later = Parts(*(part[1:] for part in CORNER[:3]), SQUARE.clip(max=[0.25, 0.5]))
    parts = (CORNER, CORNER._replace(ends=CORNER.ends * 0.8), later)
    grids = np.stack([filled_cells(each, 8, 1.1) for each in parts])
    labels, common = np.array([2, 1, 2]), np.array([True, True, False])
    return Prototypes(parts, grids, rng.uniform(0.5, 2, (3, 3)), labels, common)


@pytest.fixture
def decoder(prototypes) -> PrototypeDecoder:
    torch.manual_seed(0)
    decoder = PrototypeConfig(prototypes=5, codes=30, width=8, cells=8).build(6)
    decoder.set_prototypes(prototypes)
    return decoder


def test_an_object_has_the_look_whose_code_is_nearest(decoder, torch_rng):
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


def test_prototypes_are_kept_in_checkpoints_and_are_no_weights(decoder, prototypes):
    fresh = PrototypeConfig(prototypes=5, codes=30, width=8, cells=8).build(6)
    assert fresh.known == []
    assert fresh.looks(torch.zeros(2, 30)).tolist() == [0, 0]
    fresh.load_state_dict(decoder.state_dict())
    for one, other in zip(fresh.prototypes[1:], prototypes[1:], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)
    for one, other in zip(fresh.prototypes.parts, prototypes.parts, strict=True):
        for here, there in zip(one, other, strict=True):
            np.testing.assert_allclose(here, there, rtol=1e-6)
    assert all(name.startswith("mlp.") for name, _ in fresh.named_parameters())


def test_meshes_and_solids_turn_and_fill_boxes_as_grids_do():
    """On a shape without symmetry: a look's mesh against the cells of its turned grid, and the
    union of its solids against the mesh."""
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

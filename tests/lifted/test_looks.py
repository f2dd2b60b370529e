"""Occupancy grids: prototypes, their looks, and how the prior decodes them."""

import numpy as np
import pytest
import torch
import trimesh
from tiny_runs import tiny_lifted

from sceneprior.core.geometry.isosurface import surface_of
from sceneprior.core.geometry.turns import turn_grids
from sceneprior.lifted.looks import LookConfig, LookDecoder
from sceneprior.lifted.prototypes import POSES, Prototypes, turn_of
from sceneprior.paper.prior import ScenePrior

SMALL = {"prototypes": 9, "codes": 4, "width": 8, "cells": 8, "margin": 1.2}


@pytest.fixture
def prior(tmp_path) -> ScenePrior:
    return tiny_lifted(tmp_path, model__shape=SMALL).build_prior()


@pytest.fixture
def prototypes() -> Prototypes:
    """Three shapes without symmetry."""
    rng = np.random.default_rng(0)
    grids, labels = rng.random((3, 8, 8, 8)) < 0.5, np.array([2, 1, 2])
    return Prototypes(grids, rng.random((3, 3)), labels, np.array([True, True, False]))


@pytest.fixture
def decoder(prototypes) -> LookDecoder:
    torch.manual_seed(0)
    decoder = LookConfig(prototypes=5, codes=30, width=8, cells=8).build(6)
    decoder.learn_prototypes(prototypes)
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
    assert torch.equal(cells, decoder.filled[looks // POSES]) and (cells > 100).all()


def test_prototypes_are_kept_in_checkpoints_and_are_no_weights(decoder, prototypes):
    fresh = LookConfig(prototypes=5, codes=30, width=8, cells=8).build(6)
    assert len(fresh.prototypes.grids) == 0
    assert fresh.looks(torch.zeros(2, 30)).tolist() == [0, 0]
    fresh.load_state_dict(decoder.state_dict())
    for one, other in zip(fresh.prototypes, prototypes, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)
    assert all(name.startswith("mlp.") for name, _ in fresh.named_parameters())


def test_meshes_turn_and_fill_boxes_as_grids_do():
    """A look's mesh against the surface of its turned grid, on a shape without symmetry."""
    rng = np.random.default_rng(0)
    decoder = LookConfig(prototypes=2, codes=8, cells=8).build(6)
    grids = np.zeros((1, 8, 8, 8), dtype=bool)
    grids[0, 1:, 1:4, 2:7] = True
    grids[0, 2:4, 1:7, 2:4] = True
    decoder.learn_prototypes(
        Prototypes(grids, np.ones((1, 3)), np.array([1]), np.ones(1, dtype=bool))
    )
    box = np.array([*rng.normal(size=3), 2.0, 0.5, 1.0])
    for pose in range(POSES):
        mesh = decoder.mesh(pose, box)
        turned = turn_grids(grids, *turn_of(pose))[0]
        slow = surface_of(turned - 0.5, box[:3], box[3:], decoder.margin)
        here, there = trimesh.Trimesh(mesh.vertices_m, mesh.faces), trimesh.Trimesh(*slow)
        # A cell's corners may be cut along its other diagonal.
        assert here.volume == pytest.approx(there.volume, rel=0.02) and here.volume > 0
        assert np.allclose(here.bounds, there.bounds, atol=1e-6)
        assert np.allclose(here.center_mass, there.center_mass, atol=0.02)


def test_the_prior_decodes_looks_in_place_of_meshes(prior, torch_rng):
    logits = torch.randn(3, 10, generator=torch_rng)
    scenes = prior(logits)
    assert prior.faces is None and scenes.vertices_m is None
    assert scenes.looks.shape == (3, 6)
    bare = prior(logits, with_shape=False)
    assert scenes.shape_codes.shape == (3, 6, 4)
    assert bare.looks is None and torch.equal(bare.shape_codes, scenes.shape_codes)
    assert torch.equal(bare.centers_m, scenes.centers_m)

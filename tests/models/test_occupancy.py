"""Occupancy grids: sums of given grids, and how the prior decodes them."""

import numpy as np
import pytest
import torch
from tiny_runs import OCCUPANCY, tiny_baseline, tiny_config
from torch.testing import assert_close

from sceneprior.errors import ConfigError
from sceneprior.models.occupancy import OccupancyConfig, OccupancyDecoder
from sceneprior.models.prior import ScenePrior
from sceneprior.models.shape_decoder import ShapeDecoderConfig

SMALL = {"name": "occupancy", "codes": 4, "width": 8, "cells": 8, "margin": 1.2}
GRIDS = {**OCCUPANCY, "model__shape": SMALL}


@pytest.fixture
def prior(tmp_path) -> ScenePrior:
    return tiny_config(tmp_path, **GRIDS).build_prior()


@pytest.fixture
def decoder(torch_rng) -> OccupancyDecoder:
    """In a space of three random grids."""
    torch.manual_seed(0)
    decoder = OccupancyConfig(codes=3, width=8, cells=8).build(6)
    rng = np.random.default_rng(0)
    decoder.set_space(rng.random((8, 8, 8)), rng.standard_normal((3, 8, 8, 8)), 2.5)
    return decoder.double()


def test_logits_are_of_weighted_sums_of_the_grids(decoder, torch_rng):
    features = torch.randn(2, 3, 6, generator=torch_rng, dtype=torch.float64)
    logits = decoder(features)
    for room in range(2):
        for item in range(3):
            weights = 2.5 * decoder.mlp(features[room, item])
            grid = decoder.mean + sum(weights[k] * decoder.basis[k] for k in range(3))
            assert_close(logits[room, item], 8 * (grid - 0.5), rtol=0, atol=1e-12)
    assert torch.equal(logits, decoder.grids(decoder.codes(features)))


def test_the_space_is_kept_in_checkpoints_and_is_no_weight(decoder):
    fresh = OccupancyConfig(codes=3, width=8, cells=8).build(6)
    assert not fresh.basis.any() and not fresh.mean.any()
    fresh.double().load_state_dict(decoder.state_dict())
    assert torch.equal(fresh.basis, decoder.basis) and fresh.spread == 2.5
    assert not {"mean", "basis", "spread"} & {name for name, _ in fresh.named_parameters()}
    # Half precision in the file: a cell's occupancy is known to 0.0005.
    assert OccupancyConfig().build(6).basis.dtype == torch.float16


def test_every_weight_learns_from_every_object(decoder, torch_rng):
    features = torch.randn(1, 4, 6, generator=torch_rng, dtype=torch.float64)
    decoder(features).square().sum().backward()
    assert all(parameter.grad.any() for parameter in decoder.parameters())


def test_the_prior_decodes_grids_in_place_of_meshes(prior, torch_rng):
    logits = torch.randn(3, 10, generator=torch_rng)
    scenes = prior(logits)
    assert prior.faces is None and scenes.vertices_m is None
    assert scenes.occupancy.shape == (3, 6, 8, 8, 8) and scenes.margin == 1.2
    bare = prior(logits, with_shape=False)
    assert scenes.shape_codes.shape == (3, 6, 4)
    assert bare.occupancy is None and torch.equal(bare.shape_codes, scenes.shape_codes)
    assert torch.equal(bare.centers_m, scenes.centers_m)


def test_only_wanted_objects_have_grids_and_the_others_are_empty(prior, torch_rng):
    z = prior.latent_space(torch.randn(3, 10, generator=torch_rng))
    wanted = torch.tensor([[True, False], [True, True], [False, False]])
    some, everything = prior.decode(z, wanted=wanted), prior.decode(z)
    # Products of other matrices: the same sums of 16 numbers in another order.
    assert_close(some.occupancy[wanted], everything.occupancy[:, :2][wanted], rtol=1e-5, atol=1e-6)
    assert (some.occupancy[~wanted] == -20).all()


def test_a_shape_without_a_name_is_a_mesh(tmp_path):
    shape = tiny_config(tmp_path, model__shape={"width": 8}).model.shape
    assert shape == ShapeDecoderConfig(name="mesh", width=8)
    assert tiny_config(tmp_path, **GRIDS).model.shape == OccupancyConfig(**SMALL)


@pytest.mark.parametrize(
    ("shape", "sentence"),
    [
        ({"name": "cloud"}, "no name of 'model.shape' is 'cloud'; choose from mesh, occupancy."),
        ("occupancy", "'model.shape' is a section; write {name: ...} with one of mesh, occupancy."),
        ({"name": "occupancy", "level": 2}, "unknown key 'model.shape.level'; the nearest valid"),
        ({"name": "occupancy", "cells": 4}, "'model.shape.cells': input should be greater than or"),
        ({"name": "occupancy", "margin": 0.9}, "'model.shape.margin': input should be greater"),
    ],
)  # fmt: skip
def test_wrong_shapes_are_sentences(tmp_path, shape, sentence):
    with pytest.raises(ConfigError) as error:
        tiny_config(tmp_path, model__shape=shape)
    assert sentence in str(error.value)


def test_the_gan_draws_meshes_alone(tmp_path):
    with pytest.raises(ConfigError, match=r"'model.shape.name': input should be 'mesh' \(got 'occ"):
        tiny_baseline(tmp_path, "gan", model__shape=SMALL)


@pytest.mark.parametrize("changes", [{"model__shape": SMALL}, {"shape": OCCUPANCY["shape"]}])
def test_a_shape_and_what_teaches_it_go_together(tmp_path, changes):
    with pytest.raises(ConfigError, match=r"model.shape is '\w+', which is learnt with"):
        tiny_config(tmp_path, **changes)

"""Occupancy grids: where they start, how coarse and fine join, and how the prior decodes them."""

import pytest
import torch
from scipy import ndimage
from tiny_runs import OCCUPANCY, tiny_baseline, tiny_config
from torch.testing import assert_close

from sceneprior.errors import ConfigError
from sceneprior.models.occupancy import FINEST, OccupancyConfig
from sceneprior.models.prior import ScenePrior
from sceneprior.models.shape_decoder import ShapeDecoderConfig

SMALL = {"name": "occupancy", "width": 8, "cells": 8, "margin": 1.2}
GRIDS = {**OCCUPANCY, "model__shape": SMALL}


@pytest.fixture
def prior(tmp_path) -> ScenePrior:
    return tiny_config(tmp_path, **GRIDS).build_prior()


def test_a_fresh_grid_is_undecided_everywhere(torch_rng):
    torch.manual_seed(0)
    decoder = OccupancyConfig().build(1024)
    grids = decoder(torch.randn(2, 3, 1024, generator=torch_rng))
    assert grids.shape == (2, 3, 32, 32, 32)
    # Hits and misses are both likely, and no two objects are the same.
    assert grids.abs().max() < 0.5 and not torch.equal(grids[0, 0], grids[0, 1])


def test_the_learnt_grids_are_sums_of_coarse_middle_and_fine_ones():
    """Against SciPy's interpolation and filter, grid by grid."""
    torch.manual_seed(0)
    decoder = OccupancyConfig(width=8, cells=12).build(6).double()
    basis = decoder.basis().detach()
    for row in (0, 8):
        wanted = FINEST * ndimage.uniform_filter(
            decoder.fine[row].detach().numpy(), 3, mode="nearest"
        )
        for grid in (decoder.coarse[row], decoder.middle[row]):
            place = [(k + 0.5) * len(grid) / 12 - 0.5 for k in range(12)]
            places = torch.cartesian_prod(*[torch.tensor(place)] * 3).T.numpy()
            finer = ndimage.map_coordinates(grid.detach().numpy(), places, order=1, mode="nearest")
            wanted = wanted + finer.reshape(12, 12, 12)
        # The matrices are made in float32: thirds are rounded to 3e-8.
        assert_close(basis[row], torch.from_numpy(wanted), rtol=0, atol=1e-7)


def test_logits_are_weighted_sums_of_the_learnt_grids(torch_rng):
    torch.manual_seed(0)
    decoder = OccupancyConfig(width=8, cells=8).build(6).double()
    features = torch.randn(2, 3, 6, generator=torch_rng, dtype=torch.float64)
    grids, basis = decoder(features), decoder.basis()
    for room in range(2):
        for item in range(3):
            weights = decoder.code(features[room, item])
            wanted = basis[8] + sum(weights[k] * basis[k] for k in range(8))
            assert_close(grids[room, item], wanted, rtol=0, atol=1e-12)


def test_every_weight_learns_from_every_object(torch_rng):
    decoder = OccupancyConfig(width=8, cells=8).build(6)
    decoder(torch.randn(1, 4, 6, generator=torch_rng)).square().sum().backward()
    assert all(parameter.grad.any() for parameter in decoder.parameters())
    # What follows from `cells` is not kept in checkpoints.
    assert set(decoder.state_dict()) == {name for name, _ in decoder.named_parameters()}


def test_the_prior_decodes_grids_in_place_of_meshes(prior, torch_rng):
    logits = torch.randn(3, 10, generator=torch_rng)
    scenes = prior(logits)
    assert prior.faces is None and scenes.vertices_m is None
    assert scenes.occupancy.shape == (3, 6, 8, 8, 8) and scenes.margin == 1.2
    bare = prior(logits, with_shape=False)
    assert bare.occupancy is None and torch.equal(bare.centers_m, scenes.centers_m)


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
        ({"name": "occupancy", "cells": 30}, "'model.shape.cells': input should be a multiple of"),
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
    with pytest.raises(ConfigError, match=r"model.shape is '\w+', which is learnt from"):
        tiny_config(tmp_path, **changes)

"""The LSTM and the encoder of ATISS in the transformer's place."""

import pytest
import torch
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.baselines.decoders import Atiss2dConfig, SceneAtiss, SceneLstm


def lstm(width=6) -> SceneLstm:
    torch.manual_seed(0)
    return SceneLstm(width).double()


def points(torch_rng, rooms=3, width=6) -> torch.Tensor:
    return F.normalize(torch.randn(rooms, width, generator=torch_rng, dtype=torch.float64), dim=-1)


# Sums in another order, through four layers: a few roundings of numbers around 1.
TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-12}


def made(dtype=torch.float64, width=12, layers=4, dropout=0.0) -> SceneAtiss:
    torch.manual_seed(0)
    model = SceneAtiss(
        width,
        Atiss2dConfig(heads=3, hidden=20, dropout=dropout, layers=layers),
    ).to(dtype)
    with torch.no_grad():  # biases and norms as different from their start as after training
        for parameter in model.parameters():
            parameter += 0.2 * torch.randn_like(parameter)
    return model


def inputs(torch_rng, dtype=torch.float64, rooms=3, objects=6, width=12):
    z = F.normalize(torch.randn(rooms, width, generator=torch_rng, dtype=dtype), dim=-1)
    return z, torch.randn(rooms, objects, width, generator=torch_rng, dtype=dtype)


@pytest.mark.parametrize("dtype", TOLERANCE)
def test_the_next_object_does_not_depend_on_the_order_of_those_before(torch_rng, dtype):
    model = made(dtype).eval()
    z, previous = inputs(torch_rng, dtype)
    wanted = model.next_object(z, previous)
    for seed in range(5):
        order = torch.randperm(6, generator=torch.Generator().manual_seed(seed))
        shuffled = model.next_object(z, previous[:, order])
        assert_close(shuffled, wanted, rtol=0, atol=TOLERANCE[dtype])
    # ... but on what they are, and on z.
    assert (model.next_object(z, previous[:, :5]) - wanted).abs().max() > 1e-3
    assert (model.next_object(z, previous.flip(0)) - wanted).abs().max() > 1e-3
    assert (model.next_object(z.flip(0), previous) - wanted).abs().max() > 1e-3


@pytest.mark.parametrize("name", ("lstm", "atiss2d"))
def test_every_weight_has_a_gradient_that_gradcheck_confirms(torch_rng, name):
    model = lstm() if name == "lstm" else made(width=6, layers=2)
    z = points(torch_rng, rooms=1)
    model(z, 3).pow(3).sum().backward()
    assert all(parameter.grad.any() for parameter in model.parameters())
    assert torch.autograd.gradcheck(lambda x: model(x, 3), (z.requires_grad_(),), atol=1e-6)

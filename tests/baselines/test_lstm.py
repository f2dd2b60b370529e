"""The LSTM in the transformer's place: its recursion, and what it hears of z."""

import torch
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.baselines.decoders import SceneLstm


def made(width=6) -> SceneLstm:
    torch.manual_seed(0)
    return SceneLstm(width).double()


def points(torch_rng, rooms=3, width=6) -> torch.Tensor:
    return F.normalize(torch.randn(rooms, width, generator=torch_rng, dtype=torch.float64), dim=-1)


def test_each_feature_is_the_cells_answer_to_the_one_before(torch_rng):
    model, z = made(), points(torch_rng)
    features = model(z, 4)
    assert features.shape == (3, 4, 6)
    weights = model.cell.weight_ih, model.cell.weight_hh
    bias = model.cell.bias_ih + model.cell.bias_hh
    for room in range(3):
        x, hidden, cell = z[room] * 6**0.5, torch.zeros(6).double(), torch.zeros(6).double()
        for step in range(4):
            gates = weights[0] @ x + weights[1] @ hidden + bias
            enter, forget, new, leave = gates.split(6)
            cell = forget.sigmoid() * cell + enter.sigmoid() * new.tanh()
            x = hidden = leave.sigmoid() * cell.tanh()
            assert_close(features[room, step], x, rtol=0, atol=1e-12)


def test_every_weight_has_a_gradient_that_gradcheck_confirms(torch_rng):
    model, z = made(), points(torch_rng, rooms=1)
    model(z, 3).pow(3).sum().backward()
    assert all(parameter.grad.any() for parameter in model.parameters())
    assert torch.autograd.gradcheck(lambda x: model(x, 3), (z.requires_grad_(),), atol=1e-6)

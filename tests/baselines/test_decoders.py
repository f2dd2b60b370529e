"""The LSTM and the encoder of ATISS in the transformer's place, beside their slow twins."""

import pytest
import torch
from references.scene_decoder import attend, normalise
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.baselines.decoders import Atiss2dConfig, SceneAtiss, SceneLstm


def lstm(width=6) -> SceneLstm:
    torch.manual_seed(0)
    return SceneLstm(width).double()


def points(torch_rng, rooms=3, width=6) -> torch.Tensor:
    return F.normalize(torch.randn(rooms, width, generator=torch_rng, dtype=torch.float64), dim=-1)


def test_each_feature_is_the_cells_answer_to_the_one_before(torch_rng):
    model, z = lstm(), points(torch_rng)
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


# Sums in another order, through four layers: a few roundings of numbers around 1.
TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-12}


def made(dtype=torch.float64, width=12, layers=4, dropout=0.0, norm_first=False) -> SceneAtiss:
    torch.manual_seed(0)
    model = SceneAtiss(
        width,
        Atiss2dConfig(heads=3, hidden=20, dropout=dropout, layers=layers, norm_first=norm_first),
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


@pytest.mark.parametrize("norm_first", [False, True])
def test_the_slow_twin_says_the_same(torch_rng, norm_first):
    """Token by token and head by head: z is one of the tokens, and the answer is read off it."""
    model = made(layers=2, norm_first=norm_first).eval()
    z, previous = inputs(torch_rng, rooms=2, objects=3)
    with torch.no_grad():
        answers = model.next_object(z, previous)
        for room in range(2):
            tokens = [z[room] * 12**0.5, *previous[room]]
            for layer in model.layers:
                tokens = encode(layer, tokens, norm_first)
            assert_close(answers[room], normalise(tokens[0], model.end), rtol=0, atol=1e-12)


def encode(layer, tokens, norm_first):
    """A layer of the ATISS encoder, over a list of tokens."""

    def before(token, norm):
        return normalise(token, norm) if norm_first else token

    def after(token, norm):
        return token if norm_first else normalise(token, norm)

    attention = layer.self_attn
    weights = attention.in_proj_weight.chunk(3)
    biases = attention.in_proj_bias.chunk(3)
    query, key, value = (
        [weight @ before(token, layer.norm1) + bias for token in tokens]
        for weight, bias in zip(weights, biases, strict=True)
    )
    out = []
    for token, asks in zip(tokens, query, strict=True):
        mixed = attend(asks, key, value, attention.num_heads)
        x = after(token + attention.out_proj.weight @ mixed + attention.out_proj.bias, layer.norm1)
        inner = layer.linear1.weight @ before(x, layer.norm2) + layer.linear1.bias
        inner = inner * 0.5 * (1 + torch.erf(inner / 2**0.5))  # GELU
        out.append(after(x + layer.linear2.weight @ inner + layer.linear2.bias, layer.norm2))
    return out


@pytest.mark.parametrize("name", ("lstm", "atiss2d"))
def test_every_weight_has_a_gradient_that_gradcheck_confirms(torch_rng, name):
    model = lstm() if name == "lstm" else made(width=6, layers=2)
    z = points(torch_rng, rooms=1)
    model(z, 3).pow(3).sum().backward()
    assert all(parameter.grad.any() for parameter in model.parameters())
    assert torch.autograd.gradcheck(lambda x: model(x, 3), (z.requires_grad_(),), atol=1e-6)

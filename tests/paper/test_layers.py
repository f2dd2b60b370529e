"""Dropout: which numbers it drops; repeated linear layers: outputs and gradients of plain ones."""

import pytest
import torch
from torch.testing import assert_close

from sceneprior.paper.transformer import RepeatedLinear, dropout


@pytest.mark.parametrize("p", [0.1, 0.7])
def test_each_number_is_dropped_alone_and_as_often_as_asked(p):
    torch.manual_seed(0)
    times, numbers = 4000, 60
    kept = torch.stack([dropout(torch.ones(6, 10), p) for _ in range(times)]).flatten(1)
    assert_close(kept.unique(), torch.tensor([0, 1 / (1 - p)]))
    dropped = (kept == 0).double()
    sigma = (p * (1 - p) / times) ** 0.5
    # 60 shares, then 1,770 pairs: 5 sigma of each leave one failure in a thousand seeds.
    assert (dropped.mean(dim=0) - p).abs().max() < 5 * sigma
    pairs = torch.corrcoef(dropped.T) - torch.eye(numbers)
    assert pairs.abs().max() < 5 / times**0.5
    # The number of hits is random, too: a fixed one would leave too little spread of the total.
    spread = dropped.sum(dim=1).var() / (numbers * p * (1 - p))
    assert abs(spread - 1) < 5 * (2 / times) ** 0.5


def test_gradients_pass_where_numbers_do(torch_rng):
    x = torch.randn(4, 5, generator=torch_rng, dtype=torch.float64).T.requires_grad_()
    torch.manual_seed(0)
    out = dropout(x, 0.4)
    out.backward(torch.ones_like(out))
    assert 0 < (out == 0).sum() < out.numel()
    assert_close(x.grad, out.detach() / x.detach())


ROWS = (2, 0, 5, 3)


def layers(torch_rng, bias=True):
    """Two groups of 4 inputs and 3 outputs, and an input for each use."""
    shapes = [(2, 4, 3), (2, 3), *((2, rows, 4) for rows in ROWS)]
    weight, biases, *inputs = (
        torch.randn(shape, generator=torch_rng, dtype=torch.float64, requires_grad=True)
        for shape in shapes
    )
    return weight, biases if bias else None, inputs


def loss_of(outputs):
    return sum((k * y.pow(3)).sum() for k, y in enumerate(outputs, 1))


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("used", [len(ROWS), 2])
def test_outputs_and_gradients_are_those_of_plain_layers(torch_rng, bias, used):
    weight, biases, inputs = layers(torch_rng, bias)
    leaves = [weight, *inputs[:used]] + ([biases] if bias else [])
    plain = [x @ weight + (biases[:, None] if bias else 0) for x in inputs[:used]]
    wanted = torch.autograd.grad(loss_of(plain), leaves)
    layer = RepeatedLinear(weight, biases, ROWS)
    found = [layer(x) for x in inputs[:used]]
    assert_close(found, plain, rtol=0, atol=1e-13)
    # Twice, and only in part in between: no gradient is left over from another pass.
    for _ in range(2):
        gradients = torch.autograd.grad(loss_of(found), leaves, retain_graph=True)
        assert_close(gradients, wanted, rtol=0, atol=1e-12)
        partial = torch.autograd.grad(loss_of(found[:1]), leaves[:1], retain_graph=True)
        wanted_part = torch.autograd.grad(loss_of([inputs[0] @ weight + (
            biases[:, None] if bias else 0)]), leaves[:1])  # fmt: skip
        assert_close(partial, wanted_part, rtol=0, atol=1e-12)


def test_gradcheck_confirms_the_gradients(torch_rng):
    weight, biases, inputs = layers(torch_rng)

    def outputs(weight, biases, *inputs):
        layer = RepeatedLinear(weight, biases, ROWS)
        first = layer(inputs[0])
        # A later input depends on an earlier output, as in the transformer.
        return first, *(layer(x + first.sum(dim=1, keepdim=True).mean()) for x in inputs[1:])

    assert torch.autograd.gradcheck(outputs, (weight, biases, *inputs))


def test_autocast_computes_in_its_type_and_returns_gradients_in_that_of_the_weights(torch_rng):
    weight, biases, inputs = (
        part.detach().float().requires_grad_() if isinstance(part, torch.Tensor) else part
        for part in layers(torch_rng)
    )
    x = inputs[0].detach().float()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        y = RepeatedLinear(weight, biases, ROWS)(x)
    assert y.dtype == torch.bfloat16
    y.sum().backward()
    assert weight.grad.dtype == biases.grad.dtype == torch.float32
    rounded = x.bfloat16().float()
    wanted = rounded.sum(dim=1)[..., None].expand_as(weight)
    assert_close(weight.grad, wanted, rtol=2**-7, atol=2**-7)

"""Dropout: which numbers it drops, how often, and what that does to gradients."""

import pytest
import torch
from torch.testing import assert_close

from sceneprior.paper.layers import dropout


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


def test_nothing_is_dropped_of_nothing_and_at_zero(torch_rng):
    x = torch.randn(3, 2, generator=torch_rng)
    assert torch.equal(dropout(x, 0.0), x)
    assert dropout(x[:0], 0.5).shape == (0, 2)

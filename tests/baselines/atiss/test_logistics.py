"""Mixtures of discretised logistics against scipy, sums and counts."""

import numpy as np
import pytest
import torch
from scipy import stats
from torch.testing import assert_close

from sceneprior.baselines.atiss import HALF_STEP, LEVELS, LogisticMixture


@pytest.fixture
def mixture(torch_rng) -> LogisticMixture:
    """Seven mixtures of five, from so wide that half lies outside to narrower than a step."""
    features = torch.randn(7, 15, generator=torch_rng, dtype=torch.float64)
    features[:, 10:] = 3 * features[:, 10:] - 3
    return LogisticMixture.of(features)


def test_all_steps_together_are_certain(mixture):
    steps = torch.linspace(-1, 1, LEVELS, dtype=torch.float64)
    every = torch.stack([mixture.log_prob(step.expand(7)) for step in steps]).exp()
    assert_close(every.sum(dim=0), torch.ones(7, dtype=torch.float64), rtol=0, atol=1e-12)


def test_a_step_is_a_difference_of_scipys_distribution_functions(mixture):
    rng = np.random.default_rng(1)
    values = rng.uniform(-0.99, 0.99, size=(200, 7))
    weights = mixture.weight_logits.softmax(dim=-1).numpy()
    distribution = stats.logistic(mixture.means.numpy(), mixture.log_scales.exp().numpy())
    v = values[..., None]
    # From whichever end is smaller, so that scipy's difference keeps its digits.
    below = distribution.cdf(v + HALF_STEP) - distribution.cdf(v - HALF_STEP)
    above = distribution.sf(v - HALF_STEP) - distribution.sf(v + HALF_STEP)
    each = np.where(v < mixture.means.numpy(), below, above)
    wanted = np.log((weights * each).sum(axis=-1))
    ours = torch.stack([mixture.log_prob(row) for row in torch.from_numpy(values)])
    np.testing.assert_allclose(ours.numpy(), wanted, rtol=1e-9)


def test_far_away_and_in_float32_it_stays_a_number():
    mixture = LogisticMixture(torch.zeros(1, 1), torch.full((1, 1), 0.9), torch.full((1, 1), -7.0))
    far = mixture.log_prob(torch.tensor([-0.9]))
    wanted = stats.logistic.logpdf(-1.8 / np.exp(-7.0))
    assert torch.isfinite(far).all()
    # Within the step the density grows by exp(half a step / scale): the step's near end counts.
    assert float(far) == pytest.approx(wanted + HALF_STEP / np.exp(-7.0), rel=1e-3)


def test_gradients(mixture):
    values = torch.tensor([-1.0, -0.7, -0.1, 0.0, 0.3, 0.8, 1.0], dtype=torch.float64)
    parts = [
        part.clone().requires_grad_(True)
        for part in (mixture.weight_logits, mixture.means, mixture.log_scales.clamp(min=-4))
    ]
    assert torch.autograd.gradcheck(lambda *p: LogisticMixture(*p).log_prob(values), parts)


def test_draws_follow_the_distribution(torch_rng):
    """Kolmogorov and Smirnov see no difference in 20,000 draws; they see a shift of 0.03."""
    logits = torch.tensor([0.3, -0.5, 1.0])
    means, log_scales = torch.tensor([-0.3, 0.1, 0.4]), torch.tensor([-2.5, -3.5, -3.0])
    many = LogisticMixture(*(part.expand(20_000, -1) for part in (logits, means, log_scales)))
    draws = many.draw(
        torch.rand(20_000, generator=torch_rng), torch.rand(20_000, generator=torch_rng)
    ).numpy()

    def cdf(x):
        distribution = stats.logistic(means.numpy(), log_scales.exp().numpy())
        return (logits.softmax(dim=0).numpy() * distribution.cdf(x[..., None])).sum(axis=-1)

    assert abs(draws).max() <= 1
    assert stats.kstest(draws, cdf).pvalue > 0.01
    assert stats.kstest(draws + 0.03, cdf).pvalue < 1e-6

"""Mixtures of logistics, compared with scipy's, and samples, compared with their densities."""

import numpy as np
import torch
from scipy import stats
from torch.testing import assert_close

from sceneprior.core.mixtures import LogisticMixture, draw_index


def some_mixture(numbers: int = 2, mixtures: int = 3) -> LogisticMixture:
    features = torch.randn(mixtures * (1 + 2 * numbers), generator=torch.Generator().manual_seed(1))
    return LogisticMixture.of(features.double(), numbers)


def test_densities_are_those_of_scipy():
    mixture = some_mixture()
    values = torch.tensor([[0.2, -0.4], [3.0, 1.0]], dtype=torch.float64)
    weights = mixture.weight_logits.softmax(dim=-1)
    expected = []
    for value in values:
        each = [
            weight * np.prod(stats.logistic.pdf(value, mean, scale.exp()))
            for weight, mean, scale in zip(weights, mixture.means, mixture.log_scales, strict=True)
        ]
        expected.append(np.log(sum(float(one) for one in each)))
    every = LogisticMixture(*(part.expand(2, *part.shape) for part in mixture))
    assert_close(every.log_prob(values), torch.tensor(expected, dtype=torch.float64))


def test_draws_follow_the_density():
    mixture, draws = some_mixture(numbers=1), 4000
    generator = torch.Generator().manual_seed(2)
    uniform = torch.rand(2, draws, generator=generator, dtype=torch.float64)
    values = mixture.drawn(uniform[0], uniform[1].unsqueeze(-1))[:, 0].numpy()
    weights = mixture.weight_logits.softmax(dim=-1).numpy()

    def below(x: np.ndarray) -> np.ndarray:
        each = [
            weight * stats.logistic.cdf(x, mean, np.exp(scale))
            for weight, mean, scale in zip(
                weights, mixture.means[:, 0].numpy(), mixture.log_scales[:, 0].numpy(), strict=True
            )
        ]
        return sum(each)

    assert stats.kstest(values, below).pvalue > 0.01


def test_denser_draws_are_the_first_of_the_densest_tries():
    """By the density of the mixture whose scales are at least 0.3."""
    torch.manual_seed(1)
    mixture = LogisticMixture.of(torch.randn(5, 9), 1)
    assert (mixture.log_scales < np.log(0.3)).any()
    uniform = torch.rand(5, 3, 6, 2)
    found = mixture.denser(uniform, 2)
    for row in range(5):
        one = LogisticMixture(*(part[row] for part in mixture))
        broad = one._replace(log_scales=one.log_scales.clamp(min=float(np.log(0.3))))
        for draw in range(3):
            values = [one.draw(choice, place[None]) for choice, place in uniform[row, draw]]
            density = [float(broad.log_prob(value)) for value in values]
            best = sorted(density)[-2:]
            kept = [value for value, own in zip(values, density, strict=True) if own in best]
            assert_close(found[row, draw], kept[0][0])
    every = mixture.denser(uniform, 6)
    assert_close(every, mixture.denser(uniform[:, :, :1], 1))


def test_denser_draws_keep_a_broad_component_with_as_much_in_it():
    """Half of the values are in a peak 2 cm wide, half along three metres."""
    logits, means = torch.zeros(4000, 2), torch.tensor([[[0.0], [5.0]]]).expand(4000, -1, -1)
    scales = torch.tensor([[[0.01], [0.8]]]).log().expand(4000, -1, -1)
    uniform = torch.rand(4000, 1, 8, 2, generator=torch.Generator().manual_seed(0))
    found = LogisticMixture(logits, means, scales).denser(uniform, 4)
    assert 0.05 < float((found > 2).float().mean()) < 0.5


def test_gradients_are_right():
    values = torch.tensor([[0.1, 0.7]], dtype=torch.float64, requires_grad=True)
    features = torch.randn(1, 10, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda f, v: LogisticMixture.of(f, 2).log_prob(v), (features, values)
    )


def test_impossible_choices_are_never_drawn():
    logits = torch.tensor([-torch.inf, 0.0, -torch.inf, 0.0, -torch.inf])
    uniform = torch.tensor([0.0, 0.49, 0.51, 1 - 2**-24])
    assert draw_index(logits.expand(4, -1), uniform).tolist() == [1, 1, 3, 3]

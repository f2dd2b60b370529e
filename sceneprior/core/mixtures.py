"""Mixtures of logistic distributions, parametrised by a network's output."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

LEAST_SCALE = 0.01
"""Minimum scale of a logistic; its standard deviation is 1.8 times the scale. Lifted boxes are not
accurate to the centimetre, and without a minimum the density is unbounded where many rooms share a
value."""
MOST_SCALE = 3.0
"""Maximum scale of a logistic."""
FIRST_SCALE = 0.3
"""Scale for a network output of 0, and the smallest one with which `denser` compares densities."""


class LogisticMixture(NamedTuple):
    """Mixture of K products of D logistic distributions.

    Unlike those of Gaussians, the log-densities of logistics have linear tails, so that outliers
    have bounded gradients.
    """

    weight_logits: Float[Tensor, "*batch mixtures"]
    means: Float[Tensor, "*batch mixtures numbers"]
    log_scales: Float[Tensor, "*batch mixtures numbers"]

    @classmethod
    def of(cls, features: Float[Tensor, "*batch features"], numbers: int) -> "LogisticMixture":
        """Build a mixture of D-dimensional components from a network's output.

        The output holds, for each component, the logit of its weight, D means and D log-scales;
        `numbers` is D.
        """
        weight_logits, means, scales = features.unflatten(-1, (-1, 1 + 2 * numbers)).split(
            [1, numbers, numbers], dim=-1
        )
        return cls.bounded(weight_logits[..., 0], means, scales)

    @classmethod
    def bounded(cls, weight_logits: Tensor, means: Tensor, scales: Tensor) -> "LogisticMixture":
        """Build a mixture with scales clamped to [`LEAST_SCALE`, `MOST_SCALE`]."""
        least, most = math.log(LEAST_SCALE), math.log(MOST_SCALE)
        return cls(weight_logits, means, (scales + math.log(FIRST_SCALE)).clamp(least, most))

    def log_prob(self, values: Float[Tensor, "*batch numbers"]) -> Float[Tensor, "*batch"]:
        """Log-densities of values."""
        away = (values.unsqueeze(-2) - self.means) * torch.exp(-self.log_scales)
        each = (F.logsigmoid(away) + F.logsigmoid(-away) - self.log_scales).sum(dim=-1)
        return torch.logsumexp(self.weight_logits.log_softmax(dim=-1) + each, dim=-1)

    def drawn(
        self, choice: Float[Tensor, "*batch draws"], place: Float[Tensor, "*batch draws numbers"]
    ) -> Float[Tensor, "*batch draws numbers"]:
        """Sample several values per mixture by inverse transform of uniform numbers.

        `choice` selects the components, and `place` the quantiles within them; both are uniform in
        [0, 1).
        """
        logits = self.weight_logits.unsqueeze(-2).expand(*choice.shape, -1)
        chosen = draw_index(logits, choice).unsqueeze(-1)
        mean, log_scale = (
            torch.take_along_dim(part, chosen, dim=-2) for part in (self.means, self.log_scales)
        )
        return mean + log_scale.exp() * torch.logit(place, eps=1e-6)

    def denser(
        self, uniform: Float[Tensor, "*batch values tries 2"], kept: int
    ) -> Float[Tensor, "*batch values"]:
        """Sample several values per mixture of a single number, with few in its sparse parts: each
        is the first of the `kept` densest of its `tries`. Peaks count as if `FIRST_SCALE` wide.

        `uniform` holds the choice and the place of each try; see `drawn`.
        """
        choice, place = uniform.flatten(-3, -2).split(1, dim=-1)
        tried = self.drawn(choice[..., 0], place)
        each = LogisticMixture(
            self.weight_logits.unsqueeze(-2),
            self.means.unsqueeze(-3),
            self.log_scales.unsqueeze(-3).clamp(min=math.log(FIRST_SCALE)),
        )
        density = each.log_prob(tried).unflatten(-1, uniform.shape[-3:-1])
        first = density.topk(kept).indices.amin(dim=-1, keepdim=True)
        return tried[..., 0].unflatten(-1, uniform.shape[-3:-1]).gather(-1, first)[..., 0]

    def draw(
        self, choice: Float[Tensor, "*batch"], place: Float[Tensor, "*batch numbers"]
    ) -> Float[Tensor, "*batch numbers"]:
        """Sample one value per mixture; see `drawn`."""
        return self.drawn(choice.unsqueeze(-1), place.unsqueeze(-2))[..., 0, :]


def draw_index(logits: Float[Tensor, "*#n choices"], uniform: Float[Tensor, "*#n"]) -> Tensor:
    """Sample a categorical index by inverse transform of a uniform number in [0, 1)."""
    reached = logits.softmax(dim=-1).cumsum(dim=-1) <= uniform.unsqueeze(-1)
    return reached.sum(dim=-1).clamp(max=logits.shape[-1] - 1)

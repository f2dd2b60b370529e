"""Mixtures of discretised logistics on [-1, 1]: log-probabilities and draws.

Source: Salimans et al., "PixelCNN++", ICLR 2017, as ATISS uses it for coordinates and sizes.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from sceneprior.sampler.mixtures import draw_index

LEVELS = 256
"""Steps that [-1, 1] is told apart in. On continuous coordinates a density could grow without end
where many rooms share a number; the probability of a step is at most 1."""
HALF_STEP = 1 / (LEVELS - 1)
LEAST_LOG_SCALE = -7.0
"""A logistic narrower than this is within one step anyway."""


@dataclass(frozen=True)
class LogisticMixture:
    """K logistics a number: how likely each is, where it is, and how wide."""

    weight_logits: Float[Tensor, "*batch mixtures"]
    means: Float[Tensor, "*batch mixtures"]
    log_scales: Float[Tensor, "*batch mixtures"]

    @classmethod
    def of(cls, features: Float[Tensor, "*batch triples"]) -> "LogisticMixture":
        """From a network's output, 3 K features a number."""
        weight_logits, means, log_scales = features.chunk(3, dim=-1)
        return cls(weight_logits, means, log_scales.clamp(min=LEAST_LOG_SCALE))

    def log_prob(self, values: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Log-probability of the step around each value; the outermost steps reach to infinity, so
        that the steps of [-1, 1] have probability 1 together.

        With a and b the scaled upper and lower ends of the step,

            sigmoid(a) - sigmoid(b) = sigmoid(a) * sigmoid(-b) * (1 - exp(b - a)),

        which has an accurate logarithm for every a > b.
        """
        offset = values.unsqueeze(-1) - self.means
        inverse = torch.exp(-self.log_scales)
        below_upper = F.logsigmoid((offset + HALF_STEP) * inverse)
        above_lower = F.logsigmoid((HALF_STEP - offset) * inverse)
        inside = below_upper + above_lower + torch.log(-torch.expm1(-2 * HALF_STEP * inverse))
        value = values.unsqueeze(-1)
        first, last = value < HALF_STEP - 1, value > 1 - HALF_STEP
        of_each = torch.where(first, below_upper, torch.where(last, above_lower, inside))
        return torch.logsumexp(self.weight_logits.log_softmax(dim=-1) + of_each, dim=-1)

    def draw(
        self, choice: Float[Tensor, "*batch"], place: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Values in [-1, 1] of uniform numbers: one chooses a logistic, one its quantile."""
        chosen = draw_index(self.weight_logits, choice).unsqueeze(-1)
        mean = self.means.gather(-1, chosen)[..., 0]
        scale = self.log_scales.gather(-1, chosen)[..., 0].exp()
        return (mean + scale * torch.logit(place, eps=1e-6)).clamp(-1, 1)

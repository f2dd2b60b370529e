"""Mixtures of discretised logistics on [-1, 1]: log-probabilities and sampling.

Source: Salimans et al., "PixelCNN++", ICLR 2017, as ATISS uses it for coordinates and sizes.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from sceneprior.core.mixtures import draw_index

LEVELS = 256
"""Number of steps into which [-1, 1] is divided. The probability of a step is at most 1, whereas a
continuous density could grow without bound where many rooms share a value."""
HALF_STEP = 1 / (LEVELS - 1)
LEAST_LOG_SCALE = -7.0
"""Minimum log-scale; at this scale, a logistic already lies within one step."""


@dataclass(frozen=True)
class LogisticMixture:
    """A mixture of K weighted logistics for each number."""

    weight_logits: Float[Tensor, "*batch mixtures"]
    means: Float[Tensor, "*batch mixtures"]
    log_scales: Float[Tensor, "*batch mixtures"]

    @classmethod
    def of(cls, features: Float[Tensor, "*batch triples"]) -> "LogisticMixture":
        """Build the mixture from a network's output, 3 K features per number."""
        weight_logits, means, log_scales = features.chunk(3, dim=-1)
        return cls(weight_logits, means, log_scales.clamp(min=LEAST_LOG_SCALE))

    def log_prob(self, values: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Log-probability of the step around each value. The outermost steps extend to infinity, so
        that all steps together have probability 1.

        The probability of a step with scaled ends a > b is

            sigmoid(a) - sigmoid(b) = sigmoid(a) * sigmoid(-b) * (1 - exp(b - a)),

        and the logarithm of the right side is accurate for all a and b.
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
        """Samples in [-1, 1] from uniform numbers: `choice` selects the logistic, and `place` the
        quantile within it."""
        chosen = draw_index(self.weight_logits, choice).unsqueeze(-1)
        mean = self.means.gather(-1, chosen)[..., 0]
        scale = self.log_scales.gather(-1, chosen)[..., 0].exp()
        return (mean + scale * torch.logit(place, eps=1e-6)).clamp(-1, 1)

"""Rays through occupancy grids as torch has them: the slow twin of `lifted/lifting/thinning.py`."""

import math

import torch
from torch import Tensor
from torch.nn import functional as F


def ray_entropy(
    logits: Tensor, starts: Tensor, spans: Tensor, hits: Tensor, offsets: Tensor, samples: int
) -> Tensor:
    """Mean binary cross entropy over the rays that have a span."""
    share = (torch.arange(samples) + offsets[:, None]) / samples
    places = starts[:, None] + share[..., None] * spans[:, None]
    along = F.grid_sample(
        logits[None, None], places[None, None].flip(-1), padding_mode="border", align_corners=False
    )[0, 0, 0]
    soft_maximum = (4 * along).logsumexp(dim=-1) / 4 - math.log(samples) / 8
    entropy = F.binary_cross_entropy_with_logits(soft_maximum, hits.double(), reduction="none")
    return entropy[spans.abs().amax(dim=1) > 0].mean()


def regularity(logits: Tensor, variation: float, volume: float) -> Tensor:
    """Total variation along the axes, and the mean."""
    occupancy = logits.sigmoid()
    total = sum(occupancy.diff(dim=axis).abs().mean() for axis in range(3))
    return variation * total + volume * occupancy.mean()

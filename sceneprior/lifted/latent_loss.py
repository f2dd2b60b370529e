"""Sliced Wasserstein penalty that matches the training latents to the sampling distribution.

Not in the paper, which samples new rooms from the whole sphere, while the latents of training rooms
may end up where hardly any sample falls. The distance is that of Bonneel et al. 2015 (sliced
Wasserstein), applied to latents as in Kolouri et al. 2018 (sliced Wasserstein autoencoders).
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

DIRECTIONS = 32
"""Projection directions per step; they are drawn anew in each step, so a stage uses thousands."""


def latent_loss(
    logits: Float[Tensor, "rooms logits"], shift_free: bool, generator: torch.Generator
) -> Float[Tensor, ""]:
    """Sliced Wasserstein distance between the logits of all training rooms and as many from N(0,
    1).

    Args:
        shift_free: Adding a constant to a room's logits changes nothing, as on the sphere; the
            distance then ignores it, too.
        generator: On the CPU; draws the normal logits and the directions.
    """
    normal = torch.randn(logits.shape, generator=generator).to(logits)
    directions = torch.randn(logits.shape[1], DIRECTIONS, generator=generator).to(logits)
    if shift_free:
        logits = logits - logits.mean(dim=1, keepdim=True)
        normal = normal - normal.mean(dim=1, keepdim=True)
    return sliced_wasserstein(logits, normal, F.normalize(directions, dim=0))


def sliced_wasserstein(
    some: Float[Tensor, "points dimension"],
    others: Float[Tensor, "points dimension"],
    directions: Float[Tensor, "dimension directions"],
) -> Float[Tensor, ""]:
    """The mean over directions of the squared 2-Wasserstein distance of the projected points.

    In one dimension, the optimal transport between two sets of n points keeps their order.
    """
    moved = (some @ directions).sort(dim=0).values - (others @ directions).sort(dim=0).values
    return moved.square().mean()

"""What spreads the training rooms' latents as the latents of new rooms are drawn.

Not in the paper, which draws new rooms from anywhere on the sphere and lets training rooms go where
they fit best: to where nothing is drawn. The distance is of Bonneel et al. 2015 (sliced
Wasserstein), on latents as in Kolouri et al. 2018 (sliced Wasserstein autoencoders).
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

DIRECTIONS = 32
"""How many lines a step looks along: new ones in each, so that a stage sees thousands."""


def latent_loss(
    logits: Float[Tensor, "rooms logits"], shift_free: bool, generator: torch.Generator
) -> Float[Tensor, ""]:
    """How far the logits of all training rooms are from as many draws from N(0, 1).

    Args:
        shift_free: Whether a constant added to a room's logits changes nothing, as on the sphere;
            it then counts for nothing here, too.
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

    On a line, the cheapest way to move as many points onto others keeps their order.
    """
    moved = (some @ directions).sort(dim=0).values - (others @ directions).sort(dim=0).values
    return moved.square().mean()

"""Latents of training rooms in, latents of new rooms out: the distribution that sampling follows."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.errors import InputError
from sceneprior.models.latents import LatentSpace

NEIGHBOURS = 20
"""Rooms that a geodesic may lead to; more reach further from the training rooms."""

BANDWIDTH = 0.15
"""Of the kernel distribution, in standard deviations of the training rooms' logits: 0 copies training rooms,
1 is the gaussian distribution. Larger is newer, and more often a room without a bed or with two."""

DISTRIBUTIONS = ("kernel", "geodesic", "gaussian", "paper")


def sample_latents(
    sphere: LatentSpace,
    trained: Float[Tensor, "rooms anchors"],
    count: int,
    seed: int,
    distribution: str = "kernel",
) -> Float[Tensor, "count dimension"]:
    """Draw points of the latent space.

    Args:
        sphere: Turns logits into points.
        trained: The training rooms' logits.
        count: How many to draw.
        seed: Same seed, same rooms.
        distribution: `geodesic`: a point anywhere on the geodesic (in a cube: the straight line) between a
            training room drawn at random and one of its `NEIGHBOURS` nearest. The others: see
            `sample_logits`.

    Raises:
        InputError: an unknown distribution, or fewer than two training rooms to draw between.
    """
    if distribution not in DISTRIBUTIONS:
        raise InputError(
            f"No sampling distribution '{distribution}'; choose from {', '.join(DISTRIBUTIONS)}."
        )
    if distribution != "paper" and len(trained) < 2:
        raise InputError(
            f"The {distribution} distribution needs at least 2 training rooms; use --distribution paper."
        )
    if distribution != "geodesic":
        return sphere(sample_logits(trained, count, seed, distribution, sphere.shift_free))
    generator = torch.Generator().manual_seed(seed)
    start = _rooms_in_turn(len(trained), count, generator)
    z = sphere(trained)
    closeness = sphere.nearness(z[start], z)
    closeness[torch.arange(count), start] = -torch.inf  # nobody is their own neighbour
    nearest = closeness.topk(min(NEIGHBOURS, len(trained) - 1), dim=1).indices
    pick = torch.randint(nearest.shape[1], (count, 1), generator=generator)
    end = nearest.gather(1, pick)[:, 0]
    along = torch.rand(count, generator=generator).to(trained.dtype)
    return sphere.between(z[start], z[end], along)


def sample_logits(
    trained: Float[Tensor, "rooms anchors"],
    count: int,
    seed: int,
    distribution: str,
    shift_free: bool = True,
) -> Float[Tensor, "count anchors"]:
    """Draw logits of latent weights.

    Args:
        trained: The training rooms' logits.
        count: How many to draw.
        seed: Same seed, same logits.
        distribution: `paper`: N(0, 1), which is where training rooms' logits started, not where they
            ended. `gaussian`: the mean and covariance of the training rooms' logits. `kernel`:
            the same mean and covariance, as a mixture of Gaussians around the training rooms
            (a smoothed bootstrap of width `BANDWIDTH`).
        shift_free: Whether a constant added to all logits of a room changes nothing, as where a
            softmax turns them into weights; that freedom is taken out first.
    """
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(count, trained.shape[1], generator=generator, dtype=torch.float64)
    if distribution == "paper":
        return noise.to(trained.dtype)
    logits = trained.double()
    if shift_free:
        logits = logits - logits.mean(dim=1, keepdim=True)
    mean = logits.mean(dim=0)
    centred = logits - mean
    # centred^T centred is the covariance; its square root needs no positive definiteness.
    _, scale, axes = torch.linalg.svd(centred / (len(logits) - 1) ** 0.5, full_matrices=False)
    drawn = (noise[:, : len(scale)] * scale) @ axes
    if distribution == "kernel":
        start = centred[_rooms_in_turn(len(logits), count, generator)]
        # Drawn in towards the mean by as much as the noise adds: the covariance stays.
        drawn = (1 - BANDWIDTH**2) ** 0.5 * start + BANDWIDTH * drawn
    return (mean + drawn).to(trained.dtype)


def _rooms_in_turn(rooms: int, count: int, generator: torch.Generator) -> Int[Tensor, " count"]:
    """Rooms in random order, none a second time before each was there once."""
    rounds = [torch.randperm(rooms, generator=generator) for _ in range(-(-count // rooms))]
    return torch.cat(rounds)[:count]

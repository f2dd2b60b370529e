"""What rays through pixels teach occupancy grids, and total variation. Ours; not in the paper."""

import math
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from sceneprior.losses.averages import mean_of_objects
from sceneprior.views import Rays

SHARPNESS = 4.0
"""Of the soft maximum: samples whose logits differ by less than 1 / SHARPNESS share a gradient."""
LEVEL = 1e-9
"""A ray that goes less than this far along an axis for each metre is level there."""

CACHED = 4
"""Grids whose total variation is taken at once."""


def ray_loss(
    logits: Float[Tensor, "objects x y z"],
    centers_m: Float[Tensor, "objects 3"],
    sizes_m: Float[Tensor, "objects 3"],
    margin: float,
    rays: Rays,
    samples: int,
    offsets: Float[Tensor, "objects rays"],
) -> tuple[Float[Tensor, ""], dict[str, Float[Tensor, ""]]]:
    """Binary cross entropy of whether rays meet an object, from logits z_i along each of them.

        logit of a ray = log(sum_i exp(4 z_i)) / 4 - log(samples) / 8

    a soft maximum, within log(samples) / 8 of the largest z_i: below it where a single sample is
    inside the object, above it where all are.

    The z_i lie evenly on the part of the ray that is in the object's frame and before `until_m`.
    Rays without such a part do not count. The loss is the mean over all others, of all processes
    (`share_of_batch`); 0 where there are none.

    Args:
        logits: Positive inside the object; of the centres of cells that fill the frame. Trilinear
            between centres, and constant from the outermost ones to the frame's sides.
        centers_m, sizes_m: The objects' boxes. Gradients reach them: the grid moves with its box.
        margin: The frame is the box times this, about the same centre.
        rays: As many of each object; those that say nothing of it do not count.
        samples: How many z_i a ray has. Few of them jump over what is thin.
        offsets: Where in its interval each z_i of a ray lies, in [0, 1): 0.5 is the middle. Drawn
            anew in each step, they reach every place in time.

    Returns:
        The loss, and to log `ray_accuracy`: the share of counted rays that hit exactly if their
        largest z_i is positive.
    """
    places, counted = places_in_frame(centers_m, sizes_m * margin, rays, samples, offsets)
    z = F.grid_sample(
        logits.unsqueeze(1), places.unsqueeze(1), padding_mode="border", align_corners=False
    )[:, 0, 0]
    soft_maximum = (SHARPNESS * z).logsumexp(dim=-1) - math.log(samples) / 2
    hit = rays.is_hit.to(z.dtype)
    entropy = F.binary_cross_entropy_with_logits(soft_maximum / SHARPNESS, hit, reduction="none")
    right = ((z.detach().amax(dim=-1) > 0) == rays.is_hit) & counted
    accuracy = right.sum() / counted.sum().clamp(min=1)
    return mean_of_objects(entropy, counted), {"ray_accuracy": accuracy.to(z.dtype)}


def places_in_frame(
    centers_m: Float[Tensor, "objects 3"],
    frames_m: Float[Tensor, "objects 3"],
    rays: Rays,
    samples: int,
    offsets: Float[Tensor, "objects rays"],
) -> tuple[Float[Tensor, "objects rays samples 3"], Bool[Tensor, "objects rays"]]:
    """Places along the rays inside the frames, and which rays have a part there.

    A frame spans [-1, 1]; coordinates are in the order z, y, x, in which `grid_sample` reads a
    grid indexed x, y, z. The places of a ray without a part are one, somewhere.
    """
    half = frames_m.unsqueeze(1) / 2
    origin = (rays.origins_m - centers_m.unsqueeze(1)) / half
    direction = rays.directions / half
    # Where the ray crosses the planes of the frame's sides, in metres along it. A level ray crosses
    # none of an axis; it is between the two all the way, or nowhere.
    level = rays.directions.abs() < LEVEL
    per_side = 1 / direction.masked_fill(level, 1)
    low, high = (-1 - origin) * per_side, (1 - origin) * per_side
    near = torch.minimum(low, high).masked_fill(level, -torch.inf)
    far = torch.maximum(low, high).masked_fill(level, torch.inf)
    enter = near.amax(dim=-1).clamp(min=0)  # a camera may stand inside
    leave = torch.minimum(far.amin(dim=-1), rays.until_m)
    between = (~level | (origin.abs() <= 1)).all(dim=-1)
    counted = (leave > enter) & between
    length = torch.where(counted, leave - enter, 0)
    first = torch.addcmul(origin, enter.unsqueeze(-1), direction).flip(-1).unsqueeze(-2)
    whole = (length.unsqueeze(-1) * direction).flip(-1).unsqueeze(-2)
    steps = torch.arange(samples, device=offsets.device)
    share = (steps + offsets.unsqueeze(-1)) / samples
    return torch.addcmul(first, share.unsqueeze(-1), whole), counted


def total_variation(logits: Float[Tensor, "objects x y z"]) -> Float[Tensor, ""]:
    """How much occupancies, sigmoid(logits), differ from one cell to the next.

    The mean absolute difference along x, plus that along y, plus that along z. Without it, what no
    ray decides is noise.
    """
    value: Tensor = _TotalVariation.apply(logits)
    return value


class _TotalVariation(torch.autograd.Function):
    """By hand, a few objects at once, which stay in the cache: a quarter of autograd's time."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor) -> Tensor:
        slope = torch.empty_like(logits, memory_format=torch.contiguous_format)
        parts = zip(logits.detach().split(CACHED), slope.split(CACHED), strict=True)
        totals = [_variation_of(part, out) for part, out in parts]
        count = max(len(logits), 1)
        slope /= count
        ctx.save_for_backward(slope)
        return torch.stack(totals).sum() / count

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> Tensor:
        (slope,) = ctx.saved_tensors
        return upstream[0] * slope


def _variation_of(logits: Tensor, slope: Tensor) -> Tensor:
    """The sum over objects of their total variations, whose gradient is written to `slope`."""
    occupancy = logits.sigmoid()
    slope.zero_()
    for axis in (1, 2, 3):
        apart = occupancy.diff(dim=axis)
        pairs, last = math.prod(apart.shape[1:]), apart.shape[axis]
        apart.sign_()
        slope.narrow(axis, 1, last).add_(apart, alpha=1 / pairs)
        slope.narrow(axis, 0, last).sub_(apart, alpha=1 / pairs)
    # A sum of |differences| is what its gradient makes of the values themselves.
    total = torch.dot(slope.flatten(), occupancy.flatten())
    slope.copy_(torch.ops.aten.sigmoid_backward(slope, occupancy))
    return total

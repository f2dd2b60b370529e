"""Overlaps of a box with the objects of its room, and with the walls."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneprior.lifted.drawing.plans import BEYOND_M
from sceneprior.lifted.sampler.frames import GRAZE_M, shared_extents
from sceneprior.lifted.sampler.network import EncoderState

INTERSECTING = 0.01
"""Shared volume, relative to the smaller box, above which two boxes count as intersecting; the same
as in the evaluation."""


def resolve_overlap(
    boxes_m: Float[Tensor, "rooms 6"], state: EncoderState, apart: Bool[Tensor, "rooms objects"]
) -> Float[Tensor, "rooms 6"]:
    """Move boxes out of objects marked in `apart`, and into the rectangle, along each axis by at
    most `GRAZE_M`, because sampled places are not accurate to the centimetre."""
    others_m = state.before.boxes_m
    shared = shared_extents(boxes_m.unsqueeze(1), others_m)
    grazes = apart & state.before.is_object & (shared > 0).all(dim=-1)
    x_and_z, away = shared[..., ::2], (boxes_m.unsqueeze(1) - others_m)[..., [0, 2]]
    least = x_and_z == x_and_z.amin(dim=-1, keepdim=True)
    moves = x_and_z * away.sign() * (least & (x_and_z <= GRAZE_M) & grazes.unsqueeze(-1))
    centre = boxes_m[:, [0, 2]] + moves.sum(dim=1)
    middle, extents = state.rectangle_m.split(2, dim=-1)
    free = ((extents - boxes_m[:, [3, 5]]) / 2).clamp(min=0)
    inside = centre.clamp(middle - free, middle + free)
    centre = inside.where((inside - centre).abs() <= GRAZE_M, centre)
    moved = boxes_m.clone()
    moved[:, [0, 2]] = centre
    return moved


def violation(
    boxes_m: Float[Tensor, "rooms 6"], state: EncoderState, apart: Bool[Tensor, "rooms objects"]
) -> Float[Tensor, " rooms"]:
    """Violation of a box; 0 if there is none.

    The violation is the sum of two terms: the shared volumes with objects marked in `apart`, each
    relative to the smaller box, and the metres by which the box extends beyond the rectangle.
    """
    others = state.before
    here, theirs = boxes_m.unsqueeze(1), others.boxes_m
    shared = shared_extents(here, theirs).prod(dim=-1)
    least = torch.minimum(here[..., 3:].prod(dim=-1), theirs[..., 3:].prod(dim=-1))
    share = shared / least.clamp(min=1e-9)
    share = share.where((share > INTERSECTING) & others.is_object & apart, 0.0)
    middle, extents = state.rectangle_m.split(2, dim=-1)
    beyond = (boxes_m[:, [0, 2]] - middle).abs() + (boxes_m[:, [3, 5]] - extents) / 2
    return share.sum(dim=-1) + (beyond.amax(dim=-1) - BEYOND_M).clamp(min=0)

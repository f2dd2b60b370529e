"""Where an object of known size and shape must stand to be seen as a mask shows it."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.geometry.cameras import camera_centers
from sceneprior.reconstruction.outlines import Outlines, beyond, projected_extents

STEPS = 12
SPREAD = 0.012
"""How far outlines of right answers are from the masks', relative to the image size (5 px of 480):
the scale of a Laplace distribution."""
BEHIND = 50.0
"""What being wholly behind the camera costs."""
ROUND = 0.3
"""Distances below so many spreads are squared: Gauss-Newton then weighs them all alike."""
DAMPING = 2.0
LONGEST_STEP_M = 1.0
REACH_M = (0.4, 6.0)
"""How far from the camera a start may stand, along the floor; else it stands at:"""
USUAL_M = 2.5


class Placed(NamedTuple):
    """Objects where they are best seen as their masks."""

    centers_m: Float[Tensor, "objects 3"]
    energy: Float[Tensor, " objects"]
    """Minus the logarithm of how likely the mask's outline is, but for a constant."""


def place_objects(
    points: Float[Tensor, "objects points 3"],
    sizes_m: Float[Tensor, "objects 3"],
    bottom_m: Float[Tensor, " objects"],
    masks: Outlines,
) -> Placed:
    """Move objects along the floor until their outlines are those of their masks.

    What is least is the sum of absolute differences in eight directions over `SPREAD`, by
    Gauss-Newton steps with weights that are found anew each time; the best place on the way is
    taken. Heights stay: what the prior puts on the floor stands there.

    Args:
        points: Of each object's surface; its box is [-0.5, 0.5]^3.
        masks: One entry an object.
    """
    heights_m = bottom_m + sizes_m[:, 1] / 2
    shape_m = points * sizes_m[:, None]
    place_m = starting_places(heights_m, masks)
    best, energy = place_m, torch.full_like(heights_m, torch.inf)
    held = DAMPING * torch.eye(2)
    for step in range(STEPS + 1):
        centers_m = torch.stack([place_m[:, 0], heights_m, place_m[:, 1]], dim=-1)
        extents, slope, behind = projected_extents(shape_m + centers_m[:, None], masks)
        apart, slack = beyond(extents, masks)
        cost = (slack * apart.abs()).sum(dim=1) / SPREAD + BEHIND * behind
        better = cost < energy
        best, energy = torch.where(better[:, None], place_m, best), cost.minimum(energy)
        if step == STEPS:
            break
        # Outside the image an object is drawn in, from wherever it is; where the mask ends there,
        # too, nothing draws.
        at_border = (extents > masks.extents + apart) & (apart.abs() < 1e-3)
        apart = torch.where(at_border, 0.0, extents - masks.extents)
        weight = torch.where(at_border, 0.0, slack / apart.abs().clamp(min=ROUND * SPREAD))
        weighted = slope * weight[..., None] / SPREAD
        normal = slope.transpose(1, 2) @ weighted + held
        move_m = -torch.linalg.solve(normal, (weighted * apart[..., None]).sum(dim=1))
        length_m = move_m.norm(dim=1, keepdim=True)
        place_m = place_m + move_m * (LONGEST_STEP_M / length_m.clamp(min=LONGEST_STEP_M))
    return Placed(torch.stack([best[:, 0], heights_m, best[:, 1]], dim=-1), energy)


def starting_places(
    heights_m: Float[Tensor, " objects"], masks: Outlines
) -> Float[Tensor, "objects 2"]:
    """Where the ray through the middle of each mask is at the object's height: x and z."""
    left, top, right, bottom = masks.extents[:, :4].unbind(dim=1)
    middle = torch.stack([right - left, bottom - top], dim=-1) / 2
    focal = masks.intrinsics[:, (0, 1), (0, 1)]
    on_plane = (middle - masks.intrinsics[:, :2, 2]) / focal
    ray = torch.cat([on_plane, torch.ones_like(on_plane[:, :1])], dim=1)
    ray = (ray[:, None] @ masks.world_to_camera[:, :3, :3])[:, 0]
    eye_m = camera_centers(masks.world_to_camera)
    level = ray[:, ::2].norm(dim=1).clamp(min=1e-6)
    steep = ray[:, 1].abs().clamp(min=1e-6).copysign(ray[:, 1])
    along = (heights_m - eye_m[:, 1]) / steep
    near_m, far_m = REACH_M
    there = (along * level > near_m) & (along * level < far_m)
    along = torch.where(there, along, USUAL_M / level)
    return eye_m[:, ::2] + along[:, None] * ray[:, ::2]

"""Placement of objects of known size and shape so that they project onto their masks."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.core.cameras import camera_centers, pixel_rays
from sceneprior.lifted.reconstruction.outlines import Outlines, beyond, projected_extents

STEPS = 12
"""Gauss-Newton steps."""
SPREAD = 0.012
"""Scale of the Laplace distribution assumed for the distance between the outline of a correct
reconstruction and that of its mask, relative to the image size (5 px of 480)."""
BEHIND = 50.0
"""Energy of an object that is entirely behind the camera."""
ROUND = 0.3
"""Multiple of `SPREAD` below which distances are penalised quadratically; Gauss-Newton gives all of
these the same weight."""
DAMPING = 2.0
"""Damping of the Gauss-Newton steps: multiple of the identity added to the normal matrix."""
LONGEST_STEP_M = 1.0
"""Maximum length of a Gauss-Newton step."""
REACH_M = (0.4, 6.0)
"""Range of distances from the camera, along the floor, within which a starting position must be."""
USUAL_M = 2.5
"""Distance used instead if a starting position is outside that range."""


class Placed(NamedTuple):
    """Objects placed where they fit their masks best."""

    centers_m: Float[Tensor, "objects 3"]
    energy: Float[Tensor, " objects"]
    """Negative log-likelihood of the mask's outline, up to a constant."""


def place_objects(
    points: Float[Tensor, "objects points 3"],
    sizes_m: Float[Tensor, "objects 3"],
    bottom_m: Float[Tensor, " objects"],
    masks: Outlines,
) -> Placed:
    """Move objects along the floor until their outlines fit those of their masks.

    The energy is the sum of absolute differences in eight directions over `SPREAD`. It is minimised
    by Gauss-Newton steps, reweighted in each step; the best position of all steps is kept. Heights
    are fixed: objects that the prior puts on the floor stay there. `points` lie on each object's
    surface, in the frame in which its box is [-0.5, 0.5]^3; `masks` has one entry per object.
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
        # An object that extends out of the image is pulled back in from any distance, unless its
        # mask ends at the image border, too.
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
    """Position (x, z) at which the ray through the middle of each mask reaches the object's
    height."""
    left, top, right, bottom = masks.extents[:, :4].unbind(dim=1)
    middle = torch.stack([right - left, bottom - top], dim=-1) / 2
    cameras = (masks.world_to_camera[:, None], masks.intrinsics[:, None])
    ray = pixel_rays(middle[:, None, None], *cameras)[:, 0, 0]
    eye_m = camera_centers(masks.world_to_camera)
    level = ray[:, ::2].norm(dim=1).clamp(min=1e-6)
    steep = ray[:, 1].abs().clamp(min=1e-6).copysign(ray[:, 1])
    along = (heights_m - eye_m[:, 1]) / steep
    near_m, far_m = REACH_M
    there = (along * level > near_m) & (along * level < far_m)
    along = torch.where(there, along, USUAL_M / level)
    return eye_m[:, ::2] + along[:, None] * ray[:, ::2]

"""Placement of objects of known size and shape so that they project onto their masks.

Objects and masks are compared by their outlines: their extents in eight image directions.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneprior.core.cameras import camera_centers, pixel_rays
from sceneprior.core.views import ObservedImage

DIRECTIONS = ((-1, 0), (0, -1), (1, 0), (0, 1), (-1, -1), (1, -1), (1, 1), (-1, 1))
"""Image directions (u, v), right and down: towards the sides of a 2D box (left, upper, right,
lower), then towards its corners."""
OCCLUSION_SLACK = 0.15
"""Weight of the distance by which an object extends beyond its mask where the mask may be cut off
by an occluder (`Outlines.clear` is false)."""
NEAR_M = 0.05
"""Smallest depth; points nearer to the camera, or behind it, are moved to this depth."""
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


class Outlines(NamedTuple):
    """The extents of masks in the eight `DIRECTIONS`, and the camera of each mask."""

    extents: Float[Tensor, "masks 8"]
    """The largest value of u * direction_u + v * direction_v over a mask, u and v relative to the
    image's width and height."""
    clear: Bool[Tensor, "masks 8"]
    """True if no other object touches the mask in this direction, so that the object ends there; at
    a corner, none may touch the two adjacent sides, either. At the image's border, sides are clear,
    because projected objects are clipped there like masks; corners are not."""
    world_to_camera: Float[Tensor, "masks 4 4"]
    intrinsics: Float[Tensor, "masks 3 3"]
    """Intrinsics relative to the image's size."""


def outlines_of(image: ObservedImage) -> Outlines:
    """The outlines of an image's masks, in their order; the first four extents are the sides of
    `image.boxes`."""
    ids = np.asarray(image.instance_ids, dtype=np.int64)
    height, width = ids.shape
    around = np.pad(ids, 1, constant_values=-1)
    count = len(image.object_class)
    extents, clear = np.empty((count, 8), np.float32), np.empty((count, 8), bool)
    extents[:, :4] = image.boxes * (-1, -1, 1, 1)
    clear[:, :4] = image.sides_clear
    for item in range(count):
        rows, columns = np.nonzero(ids == item + 1)
        for at, (right, down) in enumerate(DIRECTIONS[4:], start=4):
            reach = right * (columns + (right > 0)) / width + down * (rows + (down > 0)) / height
            extents[item, at] = reach.max()
            last = reach >= reach.max() - 1.5 / width
            beside = np.concatenate(
                [
                    around[1 + rows[last] + y, 1 + columns[last] + x]
                    for x, y in ((right, 0), (0, down), (right, down))
                ]
            )
            # Both adjacent sides must be clear, too: if the object continues beyond one of them,
            # its true corner may be there.
            own = clear[item, [0 if right < 0 else 2, 1 if down < 0 else 3]].all()
            clear[item, at] = own and bool(np.isin(beside, (0, item + 1)).all())
    scale = np.array([[1 / width], [1 / height], [1]])
    cameras = (image.world_to_camera, image.intrinsics * scale)
    pose, intrinsics = (
        torch.from_numpy(camera.astype(np.float32)).expand(count, -1, -1) for camera in cameras
    )
    return Outlines(torch.from_numpy(extents), torch.from_numpy(clear), pose, intrinsics)


def projected_extents(
    points_m: Float[Tensor, "objects points 3"], cameras: Outlines
) -> tuple[Float[Tensor, "objects 8"], Float[Tensor, "objects 8 2"], Float[Tensor, " objects"]]:
    """Project objects into their images, and measure their extents.

    `points_m` are in the room frame; `cameras` has one entry per object.

    Returns:
        The extents; their derivatives with respect to the object's x and z (per metre); and the
        share of each object's points that are not in front of the camera.
    """
    turn, shift = cameras.world_to_camera[:, :3, :3], cameras.world_to_camera[:, None, :3, 3]
    seen = points_m @ turn.transpose(1, 2) + shift
    depth = seen[..., 2].clamp(min=NEAR_M)
    focal = cameras.intrinsics[:, (0, 1), (0, 1)]
    middle = cameras.intrinsics[:, :2, 2]
    directions = points_m.new_tensor(DIRECTIONS)
    places = seen[..., :2] / depth[..., None] * focal[:, None] + middle[:, None]
    extents, furthest = (places @ directions.T).max(dim=1)
    point = torch.take_along_dim(seen, furthest[..., None], dim=1)
    depth = torch.take_along_dim(depth, furthest, dim=1)
    # d(extent) / d(camera point), then along the room's x and z.
    along = directions * focal[:, None] / depth[..., None]
    inwards = -(along * point[..., :2]).sum(dim=-1, keepdim=True) / depth[..., None]
    moved = torch.cat([along, inwards], dim=-1) @ turn[:, :, ::2]
    return extents, moved, (seen[..., 2] < NEAR_M).to(depth).mean(dim=1)


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
    # Start where the ray through the middle of each mask reaches the object's height.
    left, top, right, bottom = masks.extents[:, :4].unbind(dim=1)
    middle = torch.stack([right - left, bottom - top], dim=-1) / 2
    cameras = (masks.world_to_camera[:, None], masks.intrinsics[:, None])
    ray = pixel_rays(middle[:, None, None], *cameras)[:, 0, 0]
    eye_m = camera_centers(masks.world_to_camera)
    level = ray[:, ::2].norm(dim=1).clamp(min=1e-6)
    along = (heights_m - eye_m[:, 1]) / ray[:, 1].abs().clamp(min=1e-6).copysign(ray[:, 1])
    near_m, far_m = REACH_M
    there = (along * level > near_m) & (along * level < far_m)
    along = torch.where(there, along, USUAL_M / level)
    place_m = eye_m[:, ::2] + along[:, None] * ray[:, ::2]
    best, energy = place_m, torch.full_like(heights_m, torch.inf)
    held = DAMPING * torch.eye(2)
    border = points.new_tensor(DIRECTIONS).clamp(min=0).sum(dim=1)
    for step in range(STEPS + 1):
        centers_m = torch.stack([place_m[:, 0], heights_m, place_m[:, 1]], dim=-1)
        extents, slope, behind = projected_extents(shape_m + centers_m[:, None], masks)
        # Signed distances beyond the masks, clipped at the image's sides and corners as masks are.
        apart = extents.minimum(border) - masks.extents
        slack = torch.where((apart > 0) & ~masks.clear, OCCLUSION_SLACK, 1.0)
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

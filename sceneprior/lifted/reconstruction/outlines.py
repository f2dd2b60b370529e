"""Outlines: the extents, in eight image directions, of masks and of projected objects."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneprior.core.observed_image import ObservedImage

DIRECTIONS = ((-1, 0), (0, -1), (1, 0), (0, 1), (-1, -1), (1, -1), (1, 1), (-1, 1))
"""Image directions (u, v), right and down: towards the sides of a 2D box (left, upper, right,
lower), then towards its corners."""
OCCLUSION_SLACK = 0.15
"""Weight of the distance by which an object extends beyond its mask where the mask may be cut off
by an occluder (`Outlines.clear` is false)."""
NEAR_M = 0.05
"""Smallest depth; points nearer to the camera, or behind it, are moved to this depth."""


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


def beyond(
    extents: Float[Tensor, "objects 8"], observed: Outlines
) -> tuple[Float[Tensor, "objects 8"], Float[Tensor, "objects 8"]]:
    """Signed distances by which objects extend beyond their masks, and the weights of these
    distances. Objects are clipped at the image's sides and corners, as masks are."""
    directions = extents.new_tensor(DIRECTIONS)
    border = directions.clamp(min=0).sum(dim=1)
    apart = extents.minimum(border) - observed.extents
    slack = torch.where((apart > 0) & ~observed.clear, OCCLUSION_SLACK, 1.0)
    return apart, slack

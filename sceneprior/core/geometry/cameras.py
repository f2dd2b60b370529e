"""Pinhole cameras: projection, 2D boxes of points, rays (OpenCV axes, docs/conventions.md)."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MIN_DEPTH_M = 1e-3
"""Minimum depth. Points at or behind the camera are moved to this depth before the division, as in
the authors' code."""


class Boxes2D(NamedTuple):
    """2D boxes of objects and whether each object is in the view's frustum."""

    boxes: Float[Tensor, "rooms views objects 4"]
    in_frustum: Bool[Tensor, "rooms views objects"]


def project(
    points_m: Float[Tensor, "rooms objects points 3"],
    world_to_camera: Float[Tensor, "rooms views 4 4"],
    intrinsics: Float[Tensor, "rooms views 3 3"],
) -> Float[Tensor, "rooms views objects points 3"]:
    """Project world points into every view of their room: u and v in pixels, depth z in metres.

    If z is below `MIN_DEPTH_M`, u and v are computed with that depth; the returned z is unchanged.
    """
    rooms, views = world_to_camera.shape[:2]
    _, objects, points, _ = points_m.shape
    rows = (intrinsics @ world_to_camera[..., :3, :3]).reshape(rooms, views * 3, 3)
    offset = (intrinsics @ world_to_camera[..., :3, 3:]).reshape(rooms, views * 3, 1)
    # Coordinates are the first axis, so that the search for extremes reads memory contiguously.
    columns = points_m.reshape(rooms, objects * points, 3).transpose(1, 2)
    scaled = torch.baddbmm(offset, rows, columns)
    scaled = scaled.reshape(rooms, views, 3, objects, points)
    depth = scaled[:, :, 2:]
    pixels = scaled[:, :, :2] / depth.clamp(min=MIN_DEPTH_M)
    return torch.cat([pixels, depth], dim=2).movedim(2, -1)


def boxes_of_points(
    points_m: Float[Tensor, "rooms objects points 3"],
    world_to_camera: Float[Tensor, "rooms views 4 4"],
    intrinsics: Float[Tensor, "rooms views 3 3"],
    image_size: tuple[int, int],
) -> Boxes2D:
    """2D bounding box of each object's projected points in every view (paper, section 3.4).

    The points are mesh vertices or box corners, in world metres. The intrinsics are in pixels of an
    image of `image_size`, (height, width). Boxes x1, y1, x2, y2 are relative to the image size and
    clamped to [0, 1]. `in_frustum` is true if some point is in front of the camera and the
    unclamped box intersects the image. Outside the frustum, the clamped box has no useful gradient,
    so the frustum loss is used there instead of the box loss.
    """
    height, width = image_size
    rooms, views = world_to_camera.shape[:2]
    with torch.no_grad():
        pixels = project(points_m, world_to_camera, intrinsics)
        in_front = (pixels[..., 2] > MIN_DEPTH_M).any(dim=-1)
        pixels = pixels[..., :2]
        at = torch.cat([pixels.argmin(dim=-2), pixels.argmax(dim=-2)], dim=-1)
    # Only the four extreme points of each object and view are projected with gradients.
    room = torch.arange(rooms, device=at.device).reshape(-1, 1, 1, 1)
    item = torch.arange(points_m.shape[1], device=at.device).unsqueeze(-1)
    cameras = (each.flatten(0, 1).unsqueeze(1) for each in (world_to_camera, intrinsics))
    ends = project(points_m[room, item, at].flatten(0, 1), *cameras)[:, 0]
    sides = torch.stack([ends[..., k, k % 2] for k in range(4)], dim=-1).unflatten(
        0, (rooms, views)
    )
    boxes = sides / sides.new_tensor([width, height, width, height])
    meets_image = ((boxes[..., :2] < 1) & (boxes[..., 2:] > 0)).all(dim=-1)
    return Boxes2D(boxes.clamp(0, 1), in_front & meets_image)


def camera_centers(
    world_to_camera: Float[Tensor, "*batch 4 4"],
) -> Float[Tensor, "*batch 3"]:
    """Camera centres in world metres."""
    rotation, translation = world_to_camera[..., :3, :3], world_to_camera[..., :3, 3:]
    return -(rotation.transpose(-1, -2) @ translation)[..., 0]


def pixel_rays(
    pixels: Float[Tensor, "rooms views objects 2"],
    world_to_camera: Float[Tensor, "rooms views 4 4"],
    intrinsics: Float[Tensor, "rooms views 3 3"],
) -> Float[Tensor, "rooms views objects 3"]:
    """Ray directions in the world (not normalised) from each camera through pixels u, v."""
    focal = intrinsics[..., (0, 1), (0, 1)].unsqueeze(-2)
    centre = intrinsics[..., :2, 2].unsqueeze(-2)
    on_plane = (pixels - centre) / focal
    directions = torch.cat([on_plane, torch.ones_like(on_plane[..., :1])], dim=-1)
    return directions @ world_to_camera[..., :3, :3]

"""Pinhole cameras: centres, rays, projection, 2D boxes (OpenCV axes, docs/conventions.md).

Functions take numpy arrays and torch tensors alike, except for the two that training differentiates
(`project`, `boxes_of_points`), which take tensors. Preparing data does not import torch.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Shaped

from sceneprior.core.repeatable import Tensor, constants

Array = TypeVar("Array", bound=Any)
"""A numpy array or a torch tensor; data preparation does not need torch."""
MIN_DEPTH_M = 1e-3
"""Minimum depth. Points at or behind the camera are moved to this depth before the division, as in
the authors' code."""
FIELD_OF_VIEW_DEG = (5.0, 160.0)
"""Plausible fields of view along an image's longer side, from a 400 mm lens to a fisheye."""
FILLED = 0.92
"""Share of the window that the points of `framed` may fill."""


@dataclass(frozen=True)
class Pinhole:
    """A perspective camera: `point_camera = world_to_camera @ point_world`, OpenCV axes."""

    world_to_camera: np.ndarray
    """(4, 4), metres."""
    intrinsics: np.ndarray
    """(3, 3), pixels; without skew."""


@dataclass(frozen=True)
class Orthographic:
    """A parallel camera; the centre of the image lies on its optical axis."""

    world_to_camera: np.ndarray
    """(4, 4), metres. Only geometry in front of the camera is drawn."""
    metres_per_pixel: float


Camera = Pinhole | Orthographic


def camera_centers(world_to_camera: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 3"]:
    """Camera centres in world metres: -R^T t."""
    rotation, translation = world_to_camera[..., :3, :3], world_to_camera[..., :3, 3:]
    return -(rotation.mT @ translation)[..., 0]


def rigid(rotation: Any, place: Any = 0.0) -> np.ndarray:
    """The matrix, (..., 4, 4), that applies `rotation` (..., 3, 3) and then adds `place`."""
    matrix = np.tile(np.eye(4), (*np.shape(rotation)[:-2], 1, 1))
    matrix[..., :3, :3], matrix[..., :3, 3] = rotation, place
    return matrix


def camera_at(
    rotation: Float[np.ndarray, "*batch 3 3"], eye_m: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """`world_to_camera` of cameras at `eye_m` whose axes (right, down, ahead) are the rows of
    `rotation`."""
    return rigid(rotation, -(rotation @ eye_m[..., None])[..., 0])


def look_at(
    eye_m: Float[np.ndarray, "3"], target_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """`world_to_camera` of a camera at `eye_m` that looks at `target_m`, with y up.

    The viewing direction must not be vertical.
    """
    forward = target_m - eye_m
    right = np.cross(forward, [0.0, 1.0, 0.0])
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    return camera_at(np.stack([right, np.cross(forward, right), forward]), eye_m)


def to_camera(
    points_m: Shaped[Array, "*points 3"], world_to_camera: Float[Array, "*batch 4 4"]
) -> Float[Array, "*result 3"]:
    """World points in the axes of each camera; points and cameras are broadcast like the
    operands of a matrix product, (..., n, 3) and (..., 4, 4)."""
    rotation, translation = world_to_camera[..., :3, :3], world_to_camera[..., None, :3, 3]
    return points_m @ rotation.mT + translation


def to_pixels(
    points_m: Float[np.ndarray, "*batch points 3"], intrinsics: Float[np.ndarray, "*batch 3 3"]
) -> Float[np.ndarray, "*batch points 2"]:
    """Pixels u, v of points in the axes of their cameras, at a depth other than 0."""
    return ((points_m / points_m[..., 2:]) @ intrinsics.mT)[..., :2]


def pixel_rays(
    pixels: Shaped[Array, "*views points 2"],
    world_to_camera: Float[Array, "*views 4 4"],
    intrinsics: Float[Array, "*views 3 3"],
) -> Float[Array, "*views points 3"]:
    """Ray directions in the world (not normalised) from each camera through pixels u, v."""
    focal = intrinsics.reshape(*intrinsics.shape[:-2], 9)[..., None, 0:5:4]  # the diagonal
    centre = intrinsics[..., :2, 2][..., None, :]
    on_plane = (pixels - centre) / focal
    if isinstance(on_plane, np.ndarray):
        directions: Any = np.concatenate([on_plane, np.ones_like(on_plane[..., :1])], axis=-1)
    else:
        import torch

        directions = torch.cat([on_plane, torch.ones_like(on_plane[..., :1])], dim=-1)
    return directions @ world_to_camera[..., :3, :3]


def nearest_to_rays(
    origins_m: Float[np.ndarray, "*batch rays 3"],
    directions: Float[np.ndarray, "*batch rays 3"],
    weak: float,
    weak_m: Float[np.ndarray, "*batch 3"] | float = 0.0,
    used: Bool[np.ndarray, "*batch rays"] | None = None,
) -> Float[np.ndarray, "*batch 3"]:
    """The point with the least sum of squared distances from rays.

    Args:
        directions: Unit vectors.
        weak: Weight of the squared distance from `weak_m`, which keeps parallel rays solvable.
        used: False for rays to leave out.

    Example: two rays that pass each other at a distance of 2.

        >>> origins = np.array([[0.0, 1, 0], [5, -1, 3]])
        >>> nearest_to_rays(origins, np.array([[1.0, 0, 0], [0, 0, 1]]), 1e-9).round(6).tolist()
        [5.0, 0.0, 0.0]
    """
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    if used is not None:
        across = across * used[..., None, None]
    pull = (across @ origins_m[..., None]).sum(axis=-3)[..., 0] + weak * np.asarray(weak_m)
    return np.linalg.solve(across.sum(axis=-3) + weak * np.eye(3), pull[..., None])[..., 0]


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
    import torch

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
    import torch

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
    boxes = sides / constants(sides, width, height, width, height)
    meets_image = ((boxes[..., :2] < 1) & (boxes[..., 2:] > 0)).all(dim=-1)
    return Boxes2D(boxes.clamp(0, 1), in_front & meets_image)


def odd_field_of_view(focal_px: float, image_size: tuple[int, int]) -> str:
    """Say why a focal length is implausible and what the cause may be; "" if it is plausible.

    Example: a focal length given as a fraction of the width.

        >>> odd_field_of_view(0.8, (480, 640)).partition(",")[0]
        'a focal length of 0.8 pixels in an image of 640 x 480 sees 180 degrees'
        >>> odd_field_of_view(600.0, (480, 640))
        ''
    """
    longer = max(image_size)
    seen = math.degrees(2 * math.atan(longer / 2 / focal_px))
    least, most = FIELD_OF_VIEW_DEG
    if least <= seen <= most:
        return ""
    guess = (
        "give that of this image, not of a larger one" if seen < least
        else "give pixels, not a share of the width or millimetres"
    )  # fmt: skip
    return (
        f"a focal length of {focal_px:g} pixels in an image of {image_size[1]} x {image_size[0]} "
        f"sees {seen:.3g} degrees, expected {least:g} to {most:g}; {guess}"
    )


def framed(
    points_m: Float[np.ndarray, "points 3"],
    forward: Float[np.ndarray, "3"],
    fov_rad: float,
    aspect: float,
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Position and target of the nearest camera that sees all points, with y up.

    Args:
        forward: Viewing direction, not straight up or down.
        fov_rad: Vertical field of view.
        aspect: Width-to-height ratio of the window.
    """
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    upward = np.cross(right, forward)
    depth = points_m @ forward
    slope = FILLED * np.tan(fov_rad / 2)
    # A camera at depth -away sees a point if |across - middle| <= slope * (depth + away).
    middle, away = [], []
    for across, own in ((points_m @ right, slope * aspect), (points_m @ upward, slope)):
        high, low = (across - own * depth).max(), (-across - own * depth).max()
        middle.append((high - low) / 2)
        away.append((high + low) / 2 / own)
    eye = middle[0] * right + middle[1] * upward - max(away) * forward
    return eye, eye + (depth.mean() + max(away)) * forward

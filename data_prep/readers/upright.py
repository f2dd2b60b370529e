"""Upright 3D boxes of tracked objects, fitted to their 2D boxes in all views, and the floor below.

Each box has seven parameters: centre (3), logarithms of the sizes (3), yaw.
"""

from typing import NamedTuple

import numpy as np

from sceneprior.core.boxes import CUBE_CORNERS
from sceneprior.core.cameras import camera_centers, nearest_to_rays, pixel_rays
from sceneprior.core.observations import Sightings

VIEWS_AT_MOST = 10
"""Maximum number of views used per object; more only take longer."""
_VIEWS_AT_LEAST = 3
_PARALLAX_RAD = np.radians(10)
"""Minimum of the widest angle between two rays to an object; below it, distance is uncertain."""
_NEAR_M = 0.05
_STEPS, _PATIENCE = 30, 3
"""Maximum number of steps, and of consecutive steps without progress."""
_DELTA = 1e-5
"""Step of the finite differences, in metres, logarithms and radians."""
_SIDES_AT_LEAST = 8
"""Minimum number of unoccluded sides, over all views, to determine a box's seven parameters."""

_MISFIT_SHARE = 0.01
"""Maximum mean distance between a projected box and its 2D boxes, relative to the image's longer
side, for its bottom to be used."""
_AGREE_M = 0.1
"""Maximum height difference between the bottoms of pieces on the same floor."""
_LOWER_SIDES = 2
"""Minimum number of views in which the lower side of a piece is unoccluded."""


class _Given(NamedTuple):
    """Observations that the boxes of n objects are fitted to, at most V views of each."""

    boxes_px: np.ndarray
    """(n, V, 4) 2D boxes in pixels."""
    clear: np.ndarray
    """(n, V, 4) bool: the side is unoccluded (`own_sides`)."""
    chosen: np.ndarray
    """(n, V) bool; false rows are padding."""
    poses: np.ndarray
    """(n, V, 4, 4) world-to-camera matrices."""
    lenses: np.ndarray
    """(n, V, 3, 3) intrinsics in pixels."""


def own_sides(seen: Sightings, image_size: tuple[int, int]) -> np.ndarray:
    """Find the sides of the 2D boxes at which the object itself ends: (T, n, 4) bool.

    At the other sides, another object or the image border may cut the object off.
    """
    height, width = image_size
    within = np.abs(seen.boxes - 0.5) < 0.5 - 0.5 / np.array([width, height] * 2)
    return seen.visible[..., None] & seen.sides_clear & within


def fit_upright(
    seen: Sightings,
    image_size: tuple[int, int],
    world_to_camera: np.ndarray,
    intrinsics: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Fit a box, rotated about +y only, to the 2D boxes of each object in T views.

    Robust least squares over the distances between the sides of the projected box and of the 2D
    box. A side that may be occluded counts only if the 2D box extends beyond the projected box
    there. `world_to_camera`, (T, 4, 4), has OpenCV axes and metres; the world's y points up.

    Returns:
        Corners of the boxes in the order of `CUBE_CORNERS`, (n, 8, 3), NaN where the views do not
        determine a box; and the mean distance in pixels between the projected sides and the
        unoccluded sides of the 2D boxes, (n,).
    """
    given = _given(seen, image_size, world_to_camera, intrinsics)
    start, told = _starts(given)
    best = np.full((len(start), 7), np.nan)
    misfit = np.full(len(start), np.inf)
    if told.any():
        part = _Given(*(array[told] for array in given))
        for yaw in (0.0, np.pi / 4):  # each may lead to another local minimum
            first = start[told]
            first[:, 6] = yaw
            found = _descend(first, part)
            off = np.abs(_misfits(found[:, None], part)[:, 0])
            mean = (off * part.clear).sum(axis=(1, 2)) / part.clear.sum(axis=(1, 2))
            better = mean < misfit[told]
            rows = np.flatnonzero(told)[better]
            best[rows], misfit[rows] = found[better], mean[better]
    return _corners(best), misfit


def find_floor(
    seen: Sightings, image_size: tuple[int, int], corners: np.ndarray, misfit_px: np.ndarray
) -> tuple[float, int] | None:
    """Find the height at which the lowest pieces end, along y, and the number of these pieces.

    The floor is at the bottom of the lowest boxes, which are those of `fit_upright`. None if fewer
    than two pieces agree.
    """
    believed = misfit_px < _MISFIT_SHARE * max(image_size)
    believed &= own_sides(seen, image_size)[..., 3].sum(axis=0) >= _LOWER_SIDES
    ends = corners[believed, :, 1].min(axis=1).tolist()
    for end in sorted(ends):
        same = [other for other in ends if 0 <= other - end <= _AGREE_M]
        if len(same) >= max(2, len(ends) / 4):  # a single one may be wrong
            return float(np.median(same)), len(same)
    return None


def _given(
    seen: Sightings, image_size: tuple[int, int], poses: np.ndarray, lenses: np.ndarray
) -> _Given:
    """Choose the views in which most sides of an object are unoccluded."""
    height, width = image_size
    clear = own_sides(seen, image_size)
    # Views in which the object is invisible come last.
    order = np.argsort(-(clear.sum(axis=2) + seen.visible), axis=0, kind="stable")
    views = order[:VIEWS_AT_MOST].T
    items = np.arange(views.shape[0])[:, None]
    return _Given(
        seen.boxes[views, items].astype(np.float64) * [width, height, width, height],
        clear[views, items],
        seen.visible[views, items],
        poses[views].astype(np.float64),
        lenses[views].astype(np.float64),
    )


def _starts(given: _Given) -> tuple[np.ndarray, np.ndarray]:
    """Initial boxes, (n, 7), and whether an object's views determine its position, (n,).

    A box is centred on the point nearest to the rays through the centres of the 2D boxes.
    """
    pixels = (given.boxes_px[..., :2] + given.boxes_px[..., 2:]) / 2
    rays = pixel_rays(pixels[..., None, :], given.poses, given.lenses)[..., 0, :]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    eyes = camera_centers(given.poses)
    both = given.chosen[:, :, None] & given.chosen[:, None]
    least = np.where(both, rays @ rays.swapaxes(1, 2), 1.0).min(axis=(1, 2), initial=1.0)
    told = (given.chosen.sum(axis=1) >= _VIEWS_AT_LEAST) & (least < np.cos(_PARALLAX_RAD))
    told &= given.clear.sum(axis=(1, 2)) >= _SIDES_AT_LEAST
    center = nearest_to_rays(eyes, rays, 1e-6, used=given.chosen)
    depth = given.poses[..., 2, :3] @ center[..., None]
    depth = np.maximum(depth[..., 0] + given.poses[..., 2, 3], 10 * _NEAR_M)
    focal = given.lenses[..., [0, 1], [0, 1]]
    sizes = (given.boxes_px[..., 2:] - given.boxes_px[..., :2]) * depth[..., None] / focal
    sizes = np.where(given.chosen[..., None], sizes, np.nan)
    wide, tall = np.full((2, len(told)), 1.0)
    wide[told], tall[told] = np.nanmedian(sizes[told], axis=1).T
    logs = np.log(np.stack([wide, tall, wide], axis=1))
    return np.concatenate([center, logs, np.zeros((len(told), 1))], axis=1), told


def _descend(numbers: np.ndarray, given: _Given) -> np.ndarray:
    """Refine all boxes at once by the Levenberg-Marquardt method."""
    deltas = np.concatenate([np.zeros((1, 7)), _DELTA * np.eye(7)])
    damping = np.full(len(numbers), 1e-2)
    idle = 0
    off = _misfits(numbers[:, None] + deltas, given).reshape(len(numbers), 8, -1)
    for _ in range(_STEPS):
        slopes = (off[:, 1:] - off[:, :1]).swapaxes(1, 2) / _DELTA
        weights = 1 / np.sqrt(1 + off[:, 0] ** 2)  # soft L1
        weighted = slopes * weights[..., None]
        square = weighted.swapaxes(1, 2) @ slopes
        scale = np.einsum("nii->ni", square) + 1e-9
        damped = square + np.eye(7) * (damping[:, None] * scale)[:, None]
        step = np.linalg.solve(damped, (weighted.swapaxes(1, 2) @ off[:, 0, :, None]))[..., 0]
        tried = numbers - np.clip(step, -1, 1)
        tried[:, 3:6] = np.clip(tried[:, 3:6], -5, 3)
        new = _misfits(tried[:, None] + deltas, given).reshape(off.shape)
        before, after = _cost(off[:, 0]), _cost(new[:, 0])
        better = after < before
        numbers = np.where(better[:, None], tried, numbers)
        off = np.where(better[:, None, None], new, off)
        damping = np.where(better, damping / 4, damping * 5)
        idle = 0 if (after < 0.999 * before).any() else idle + 1
        if idle == _PATIENCE:
            break
    return numbers


def _cost(off: np.ndarray) -> np.ndarray:
    return (np.sqrt(1 + off**2) - 1).sum(axis=1)


def _misfits(numbers: np.ndarray, given: _Given) -> np.ndarray:
    """Signed distances in pixels from the sides of the 2D boxes to those of the projected boxes.

    (n, C, 7) parameters of C candidate boxes per object give (n, C, V, 4) distances.
    """
    corners = _corners(numbers)
    points = corners[:, :, None] @ given.poses[:, None, :, :3, :3].swapaxes(-1, -2)
    points += given.poses[:, None, :, None, :3, 3]
    points[..., 2] = np.maximum(points[..., 2], _NEAR_M)
    pixels = points @ given.lenses[:, None].swapaxes(-1, -2)
    pixels = pixels[..., :2] / points[..., 2:]
    found = np.concatenate([pixels.min(axis=-2), pixels.max(axis=-2)], axis=-1)
    off = found - given.boxes_px[:, None]
    # An occluded mask ends too early: the projected box may be larger, not smaller.
    short = np.concatenate([np.maximum(off[..., :2], 0), np.minimum(off[..., 2:], 0)], axis=-1)
    off = np.where(given.clear[:, None], off, short)
    return off * given.chosen[:, None, :, None]


def _corners(numbers: np.ndarray) -> np.ndarray:
    """Corners, (..., 8, 3), of boxes with parameters (..., 7)."""
    cos, sin = np.cos(numbers[..., 6:]), np.sin(numbers[..., 6:])
    x, y, z = np.moveaxis(CUBE_CORNERS / 2 * np.exp(numbers[..., None, 3:6]), -1, 0)
    turned = np.stack([cos * x + sin * z, y, cos * z - sin * x], axis=-1)
    return numbers[..., None, :3] + turned

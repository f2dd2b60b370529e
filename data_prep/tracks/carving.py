"""Grid of the cells that masks may show, and what the views see of them.

A cell is kept if enough views see a mask there rather than background. The result is the visual
hull of all objects together, tolerant of missing masks and independent of their ids. Its surface,
the first filled cells on the rays of masks, is compared between views.
"""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy import ndimage

from sceneprior.core.cameras import camera_centers

BEYOND_M = 3.0
"""Maximum distance of objects from the cameras' bounding box."""
COARSE_M, FINE = 0.32, 4
"""Edge length of the coarse cells, and number of fine cells along it (8 cm each)."""
MISSED = 0.12
"""Assumed probability that an object's mask is missing in a view."""
BACKGROUND = 0.6
"""Assumed probability that a view sees background at an empty cell."""
PRIOR = -1.0
"""Prior log-odds that a cell is filled."""
CLEAR_M = 0.4
"""Radius of the empty ball around each camera: the person or the robot that held it."""
MIN_DEPTH_M = 0.1
WIDEN_PX = 1.5
"""Number of sampled pixels by which masks are widened before views are compared, since outlines,
cells and poses are not exact."""
BEHIND = 1.5
"""Number of cell edges by which a cell may lie behind the first cell of a ray and still count as
visible."""


class Cameras(NamedTuple):
    """Pinhole cameras of images that keep every `step`-th pixel."""

    to_image: Float[np.ndarray, "views 3 4"]
    """Intrinsics times `world_to_camera`, metres to pixels of the sampled images."""
    eyes_m: Float[np.ndarray, "views 3"]
    rays: Float[np.ndarray, "views 3 3"]
    """Maps (u, v, 1) to a world direction of depth 1."""
    focal_px: Float[np.ndarray, " views"]


class Grid(NamedTuple):
    """Grid of filled and empty cells between two corners, indexed x, y, z."""

    low_m: Float[np.ndarray, "3"]
    cell_m: float
    filled: Bool[np.ndarray, "x y z"]


def cameras_of(
    world_to_camera: Float[np.ndarray, "views 4 4"],
    intrinsics: Float[np.ndarray, "views 3 3"],
    step: int,
) -> Cameras:
    """Cameras of images that keep every `step`-th row and column, including the first."""
    sampled = intrinsics.astype(np.float64).copy()
    # Pixel i is pixel i * step of the original image, whose centre is at i * step + 0.5.
    sampled[:, :2] /= step
    sampled[:, :2, 2] += 0.5 - 0.5 / step
    poses = world_to_camera.astype(np.float64)
    rays = poses[:, :3, :3].mT @ np.linalg.inv(sampled)
    return Cameras(sampled @ poses[:, :3], camera_centers(poses), rays, sampled[:, 0, 0].copy())


def fill(ids: Int[np.ndarray, "views height width"], cameras: Cameras) -> Grid:
    """Find the cells that masks show, first on a coarse grid, then on a fine grid.

    `ids` are 0 for background, -1 for unknown content, and positive for masks.
    """
    tables = _table(ids > 0), _table(ids != 0)
    low = cameras.eyes_m.min(axis=0) - BEYOND_M
    high = cameras.eyes_m.max(axis=0) + BEYOND_M
    cells = np.argwhere(np.ones(np.ceil((high - low) / COARSE_M).astype(np.int64), dtype=bool))
    cells = cells[_is_filled(cells, low, COARSE_M, *cameras, *tables, True)]
    if not len(cells):
        return Grid(low, COARSE_M, np.zeros((1, 1, 1), dtype=bool))
    corner = cells.min(axis=0)
    low = low + corner * COARSE_M
    fine_m = COARSE_M / FINE
    steps = np.argwhere(np.ones((FINE,) * 3, dtype=bool))
    fine = ((cells - corner)[:, None] * FINE + steps).reshape(-1, 3)
    filled = np.zeros((cells.max(axis=0) - corner + 1) * FINE, dtype=bool)
    filled[tuple(fine[_is_filled(fine, low, fine_m, *cameras, *tables, False)].T)] = True
    return Grid(low, fine_m, filled)


def _table(there: Bool[np.ndarray, "views height width"]) -> Int[np.ndarray, "views rows columns"]:
    """Summed-area tables, padded with a first row and column of zeros."""
    sums = there.cumsum(axis=1, dtype=np.int32).cumsum(axis=2, dtype=np.int32)
    return np.pad(sums, ((0, 0), (1, 0), (1, 0)))


# no_type_check: functions compiled by Numba have no annotations.
@njit(cache=True, nogil=True)
@no_type_check
def _count(table, x1, y1, x2, y2):
    """Number of true pixels in columns x1 to x2 and rows y1 to y2 (one past the last)."""
    height, width = table.shape[0] - 1, table.shape[1] - 1
    x1, y1, x2, y2 = max(x1, 0), max(y1, 0), min(x2, width), min(y2, height)
    return table[y2, x2] - table[y1, x2] - table[y2, x1] + table[y1, x1]


@njit(cache=True, nogil=True)
@no_type_check
def centre_of(cell, low_m, cell_m):
    """World coordinates of the centre of a cell."""
    x = low_m[0] + (cell[0] + 0.5) * cell_m
    y = low_m[1] + (cell[1] + 0.5) * cell_m
    z = low_m[2] + (cell[2] + 0.5) * cell_m
    return x, y, z


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def pixel_of(matrix, point, height, width):
    """Row, column and depth in metres of a world point in a view; `matrix` (3, 4) projects points.
    The row is -1 for a point behind the camera or outside the image."""
    x, y, z = point
    depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    if depth < MIN_DEPTH_M:
        return -1, -1, depth
    u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / depth
    v = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / depth
    if not (0 <= u < width and 0 <= v < height):
        return -1, -1, depth
    return int(v), int(u), depth


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _is_filled(cells, low_m, cell_m, to_image, eyes_m, rays, focal_px, masks, known, coarse):
    """True for cells whose log-odds of being filled are positive, and that two views see filled.

    `masks` is the summed-area table of mask pixels, `known` that of mask and unknown pixels. A view
    sees a coarse cell filled if any mask lies in the cell's outline, and a fine cell if a mask lies
    at the pixel of the cell's centre.
    """
    views, height, width = masks.shape[0], masks.shape[1] - 1, masks.shape[2] - 1
    seen_filled = np.log((1 - MISSED) / (1 - BACKGROUND))
    seen_empty = np.log(MISSED / BACKGROUND)
    kept = np.zeros(len(cells), np.bool_)
    for i in range(len(cells)):
        centre = centre_of(cells[i], low_m, cell_m)
        odds, seen = PRIOR, 0
        for view in range(views):
            if not coarse:
                eye = eyes_m[view]
                a, b, c = centre[0] - eye[0], centre[1] - eye[1], centre[2] - eye[2]
                if a * a + b * b + c * c < CLEAR_M * CLEAR_M:
                    odds = -1e9
                    break
            row, column, depth = pixel_of(to_image[view], centre, height, width)
            if row < 0:
                continue
            # A coarse cell's corner is 0.87 edges from its centre.
            reach = 0.87 if coarse else 0.5
            radius = int(reach * cell_m * focal_px[view] / depth + 0.5)
            box = column - radius, row - radius, column + radius + 1, row + radius + 1
            if _count(known[view], *box) == 0:
                odds += seen_empty
            elif coarse or _count(masks[view], column, row, column + 1, row + 1):
                odds += seen_filled
                seen += 1
        kept[i] = odds > 0 and seen >= 2
    return kept


class Surface(NamedTuple):
    """Cells that are the first filled cell on some ray."""

    cells: Int[np.ndarray, "cells 3"]
    shown: Int[np.ndarray, "cells views"]
    """The id that each view shows at the cell: 0 for background, -1 if the view does not see the
    cell, because it lies outside the image, in unknown pixels, or behind other filled cells."""


def widened(ids: Int[np.ndarray, "views height width"]) -> Int[np.ndarray, "views height width"]:
    """Widen masks into the background by `WIDEN_PX`."""
    wide = ids.copy()
    for image, new in zip(ids, wide, strict=True):
        if (image > 0).any():
            far, (rows, columns) = ndimage.distance_transform_edt(image <= 0, return_indices=True)
            rim = (image == 0) & (far <= WIDEN_PX)
            new[rim] = image[rows[rim], columns[rim]]
    return wide


def surface(
    ids: Int[np.ndarray, "views height width"],
    near: Int[np.ndarray, "views height width"],
    cameras: Cameras,
    grid: Grid,
) -> Surface:
    """Find the first filled cells on the rays of masks, and the ids that all views show there;
    `near` are the ids after `widened`."""
    depth = first_hits(ids, cameras.eyes_m, cameras.rays, *grid)
    view, row, column = np.nonzero(np.isfinite(depth))
    pixels = np.stack([column + 0.5, row + 0.5, np.ones(len(view))], axis=1)
    directions = (cameras.rays[view] @ pixels[..., None])[..., 0]
    points = cameras.eyes_m[view] + depth[view, row, column, None] * directions
    at = ((points - grid.low_m) / grid.cell_m).astype(np.int64)
    at = at[((at >= 0) & (at < grid.filled.shape)).all(axis=1)]  # depths are rounded to float32
    hit = np.zeros_like(grid.filled)
    hit[tuple(at.T)] = True
    cells = np.argwhere(hit & grid.filled)
    return Surface(cells, ids_at(cells, near, cameras.to_image, grid.low_m, grid.cell_m, depth))


def votes_of(
    shown: Int[np.ndarray, "cells views"], labels: Int[np.ndarray, " masks"]
) -> Int[np.ndarray, "cells clusters"]:
    """Number of views that show each cluster of masks at each cell."""
    clusters = int(labels.max()) + 1
    rows, views = np.nonzero(shown > 0)
    index = rows * clusters + labels[shown[rows, views] - 1]
    return np.bincount(index, minlength=len(shown) * clusters).reshape(-1, clusters)


@njit(cache=True, nogil=True)
@no_type_check
def direction_of(rays, row, column):
    """World direction, scaled to depth 1, of the ray through a pixel's centre."""
    u, v = column + 0.5, row + 0.5
    x = rays[0, 0] * u + rays[0, 1] * v + rays[0, 2]
    y = rays[1, 0] * u + rays[1, 1] * v + rays[1, 2]
    z = rays[2, 0] * u + rays[2, 1] * v + rays[2, 2]
    return x, y, z


@njit(cache=True, nogil=True)
@no_type_check
def span_of(eye_m, direction, low_m, cell_m, shape):
    """Depths at which a ray enters and leaves a grid, and the ray's length per metre of depth."""
    near, far, squared = 0.0, 1e9, 0.0
    for axis in range(3):
        squared += direction[axis] * direction[axis]
        low = low_m[axis] - eye_m[axis]
        high = low + shape[axis] * cell_m
        if abs(direction[axis]) < 1e-12:
            if low > 0 or high < 0:
                far = -1.0
            continue
        a, b = low / direction[axis], high / direction[axis]
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return near, far, np.sqrt(squared)


@njit(cache=True, nogil=True)
@no_type_check
def cell_at(eye_m, direction, depth, low_m, cell_m, shape):
    """The cell (i, j, k) at a depth along a ray; (-1, -1, -1) outside the grid."""
    i = int((eye_m[0] + depth * direction[0] - low_m[0]) / cell_m)
    j = int((eye_m[1] + depth * direction[1] - low_m[1]) / cell_m)
    k = int((eye_m[2] + depth * direction[2] - low_m[2]) / cell_m)
    if 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]:
        return i, j, k
    return -1, -1, -1


@njit(cache=True, nogil=True)
@no_type_check
def first_hits(ids, eyes_m, rays, low_m, cell_m, filled):
    """Depth in metres of the first filled cell along the ray of each mask pixel, (views, height,
    width); inf if there is none."""
    depth = np.full(ids.shape, np.inf, np.float32)
    for view, row, column in np.ndindex(ids.shape):
        if ids[view, row, column] <= 0:
            continue
        eye, direction = eyes_m[view], direction_of(rays[view], row, column)
        near, far, length = span_of(eye, direction, low_m, cell_m, filled.shape)
        stride = 0.5 * cell_m / length
        t = near + 0.5 * stride
        while t < far:
            cell = cell_at(eye, direction, t, low_m, cell_m, filled.shape)
            if cell[0] >= 0 and filled[cell]:
                depth[view, row, column] = t
                break
            t += stride
    return depth


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def ids_at(cells, ids, to_image, low_m, cell_m, depth):
    """The id that each view shows at each cell, as in `Surface.shown`. `depth` is that of the first
    filled cells; inf ignores occlusion."""
    views, height, width = ids.shape
    shown = np.full((len(cells), views), -1, np.int32)
    for i in range(len(cells)):
        centre = centre_of(cells[i], low_m, cell_m)
        for view in range(views):
            row, column, far = pixel_of(to_image[view], centre, height, width)
            if row < 0:
                continue
            number = ids[view, row, column]
            if number >= 0 and (number == 0 or far <= depth[view, row, column] + BEHIND * cell_m):
                shown[i, view] = number
    return shown

"""Finds the first filled cells on the rays of masks, and the ids that views show at cells."""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from scipy import ndimage

from data_prep.tracks.voxels import Cameras, Grid, centre_of, pixel_of

WIDEN_PX = 1.5
"""Number of sampled pixels by which masks are widened before views are compared, since outlines,
cells and poses are not exact."""
BEHIND = 1.5
"""Number of cell edges by which a cell may lie behind the first cell of a ray and still count as
visible."""


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


def first_hits(
    ids: Int[np.ndarray, "views height width"], cameras: Cameras, grid: Grid
) -> Float[np.ndarray, "views height width"]:
    """Depth in metres of the first filled cell along the ray of each mask pixel; inf if there is
    none."""
    return _first_hits(ids, cameras.eyes_m, cameras.rays, *grid)


def surface(
    ids: Int[np.ndarray, "views height width"],
    cameras: Cameras,
    grid: Grid,
    depth: Float[np.ndarray, "views height width"],
) -> Surface:
    """Find the cells at the depths of `first_hits`, and the ids that all views show there."""
    hit = _cells_at(depth, cameras.eyes_m, cameras.rays, *grid)
    cells = np.argwhere(hit & grid.filled)
    return Surface(cells, ids_at(cells, ids, cameras, grid, depth))


def ids_at(
    cells: Int[np.ndarray, "cells 3"],
    ids: Int[np.ndarray, "views height width"],
    cameras: Cameras,
    grid: Grid,
    depth: Float[np.ndarray, "views height width"],
) -> Int[np.ndarray, "cells views"]:
    """The id that each view shows at each cell, as in `Surface.shown`. `depth` is that of the first
    filled cells; inf ignores occlusion."""
    return _ids_at(cells, ids, cameras.to_image, grid.low_m, grid.cell_m, depth)


def votes_of(
    shown: Int[np.ndarray, "cells views"], labels: Int[np.ndarray, " masks"]
) -> Int[np.ndarray, "cells clusters"]:
    """Number of views that show each cluster of masks at each cell."""
    clusters = int(labels.max()) + 1
    rows, views = np.nonzero(shown > 0)
    index = rows * clusters + labels[shown[rows, views] - 1]
    return np.bincount(index, minlength=len(shown) * clusters).reshape(-1, clusters)


# no_type_check: functions compiled by Numba have no annotations.
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
def _first_hits(ids, eyes_m, rays, low_m, cell_m, filled):
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


@njit(cache=True, nogil=True)
@no_type_check
def _cells_at(depth, eyes_m, rays, low_m, cell_m, filled):
    hit = np.zeros_like(filled)
    for view, row, column in np.ndindex(depth.shape):
        t = depth[view, row, column]
        if t < 1e9:
            direction = direction_of(rays[view], row, column)
            cell = cell_at(eyes_m[view], direction, t, low_m, cell_m, filled.shape)
            if cell[0] >= 0:
                hit[cell] = True
    return hit


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _ids_at(cells, ids, to_image, low_m, cell_m, depth):
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

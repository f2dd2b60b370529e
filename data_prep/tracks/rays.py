"""The cells that each view sees first, and what the other views show in their place."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from scipy import ndimage

from data_prep.tracks.voxels import Cameras, Grid, pixel_of

WIDEN_PX = 1.5
"""Sampled pixels by which masks are widened where views are compared: outlines, cells and poses
are not exact."""
BEHIND = 1.5
"""Cells by which a cell may lie behind the first one of a ray and still count as seen."""


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
    """Depth in metres of the first filled cell along the ray of each pixel of a mask; inf without
    one."""
    depth = np.full(ids.shape, np.inf, dtype=np.float32)
    _march(ids, cameras.eyes_m, cameras.rays, grid.low_m, grid.cell_m, grid.filled, depth)
    return depth


def surface(
    ids: Int[np.ndarray, "views height width"],
    cameras: Cameras,
    grid: Grid,
    depth: Float[np.ndarray, "views height width"],
) -> tuple[Int[np.ndarray, "cells 3"], Int[np.ndarray, "cells views"]]:
    """Cells that some view sees first, and the id that each view shows there.

    The id is 0 for background, and -1 where a view sees nothing of the cell: out of the image, in
    unknown pixels, or behind other filled cells.
    """
    hit = np.zeros_like(grid.filled)
    _mark(ids, cameras.eyes_m, cameras.rays, grid.low_m, grid.cell_m, depth, hit)
    cells = np.argwhere(hit & grid.filled)
    shown = np.full((len(cells), len(ids)), -1, dtype=np.int32)
    _look(cells, ids, cameras.to_image, grid.low_m, grid.cell_m, depth, shown)
    return cells, shown


# no_type_check: what Numba compiles has no annotations.
@njit(cache=True, nogil=True)
@no_type_check
def _march(ids, eyes_m, rays, low_m, cell_m, filled, found):
    views, height, width = ids.shape
    shape = filled.shape
    for view in range(views):
        eye, r = eyes_m[view], rays[view]
        for row in range(height):
            for column in range(width):
                if ids[view, row, column] <= 0:
                    continue
                u, v = column + 0.5, row + 0.5
                d = np.empty(3)
                length = 0.0
                for axis in range(3):
                    d[axis] = r[axis, 0] * u + r[axis, 1] * v + r[axis, 2]
                    length += d[axis] * d[axis]
                near, far = 0.0, 1e9
                for axis in range(3):
                    one = low_m[axis] - eye[axis]
                    two = one + shape[axis] * cell_m
                    if abs(d[axis]) < 1e-12:
                        if one > 0 or two < 0:
                            far = -1.0
                        continue
                    a, b = one / d[axis], two / d[axis]
                    near, far = max(near, min(a, b)), min(far, max(a, b))
                stride = 0.5 * cell_m / np.sqrt(length)
                t = near + 0.5 * stride
                while t < far:
                    i = int((eye[0] + t * d[0] - low_m[0]) / cell_m)
                    j = int((eye[1] + t * d[1] - low_m[1]) / cell_m)
                    k = int((eye[2] + t * d[2] - low_m[2]) / cell_m)
                    inside = 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]
                    if inside and filled[i, j, k]:
                        found[view, row, column] = t
                        break
                    t += stride


@njit(cache=True, nogil=True)
@no_type_check
def _mark(ids, eyes_m, rays, low_m, cell_m, depth, hit):
    views, height, width = ids.shape
    for view in range(views):
        eye, r = eyes_m[view], rays[view]
        for row in range(height):
            for column in range(width):
                t = depth[view, row, column]
                if not t < 1e9:
                    continue
                u, v = column + 0.5, row + 0.5
                i = int((eye[0] + t * (r[0, 0] * u + r[0, 1] * v + r[0, 2]) - low_m[0]) / cell_m)
                j = int((eye[1] + t * (r[1, 0] * u + r[1, 1] * v + r[1, 2]) - low_m[1]) / cell_m)
                k = int((eye[2] + t * (r[2, 0] * u + r[2, 1] * v + r[2, 2]) - low_m[2]) / cell_m)
                if 0 <= i < hit.shape[0] and 0 <= j < hit.shape[1] and 0 <= k < hit.shape[2]:
                    hit[i, j, k] = True


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _look(cells, ids, to_image, low_m, cell_m, depth, shown):
    views, height, width = ids.shape
    for i in range(len(cells)):
        x = low_m[0] + (cells[i, 0] + 0.5) * cell_m
        y = low_m[1] + (cells[i, 1] + 0.5) * cell_m
        z = low_m[2] + (cells[i, 2] + 0.5) * cell_m
        for view in range(views):
            row, column, far = pixel_of(to_image[view], x, y, z, height, width)
            if row < 0:
                continue
            number = ids[view, row, column]
            if number < 0 or (number > 0 and far > depth[view, row, column] + BEHIND * cell_m):
                continue
            shown[i, view] = number

"""The cells of a room's grid that its masks may show, and what each view shows of them.

A cell is kept if masks, rather than background, are seen in its place: the visual hull of all
objects together, tolerant of missing masks. No identity is needed.
"""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

BEYOND_M = 3.0
"""Largest distance of objects from the cameras' bounding box."""
COARSE_M, FINE = 0.32, 4
"""Edge length of the first grid's cells, and fine cells along it (8 cm each)."""
MISSED = 0.12
"""Assumed share of views in which an object's mask is missing."""
BACKGROUND = 0.6
"""Assumed share of views that see background in place of an empty cell."""
PRIOR = -1.0
"""Log-odds of a cell to be filled, before any view."""
CLEAR_M = 0.4
"""Radius of the empty ball around each camera: the person or the robot that held it."""
MIN_DEPTH_M = 0.1


class Cameras(NamedTuple):
    """Pinhole cameras of images that hold every `step`-th pixel."""

    to_image: Float[np.ndarray, "views 3 4"]
    """Intrinsics times `world_to_camera`, metres to pixels of the sampled images."""
    eyes_m: Float[np.ndarray, "views 3"]
    rays: Float[np.ndarray, "views 3 3"]
    """Maps (u, v, 1) to a world direction of depth 1."""
    focal_px: Float[np.ndarray, " views"]


class Grid(NamedTuple):
    """Filled cells between two corners, indexed x, y, z."""

    low_m: Float[np.ndarray, "3"]
    cell_m: float
    filled: Bool[np.ndarray, "x y z"]


def cameras_of(
    world_to_camera: Float[np.ndarray, "views 4 4"],
    intrinsics: Float[np.ndarray, "views 3 3"],
    step: int,
) -> Cameras:
    """Cameras of images of which every `step`-th row and column is kept, the first included."""
    lens = intrinsics.astype(np.float64).copy()
    # Pixel i shows i * step of the original, whose centre is at i * step + 0.5.
    lens[:, :2] /= step
    lens[:, :2, 2] += 0.5 - 0.5 / step
    poses = world_to_camera.astype(np.float64)
    turns = poses[:, :3, :3]
    eyes = -np.einsum("vji,vj->vi", turns, poses[:, :3, 3])
    rays = turns.swapaxes(1, 2) @ np.linalg.inv(lens)
    return Cameras(lens @ poses[:, :3], eyes, rays, lens[:, 0, 0].copy())


def fill(ids: Int[np.ndarray, "views height width"], cameras: Cameras) -> Grid:
    """Find the cells that masks show, coarse to fine.

    `ids` are 0 for background, -1 where unknown, else any mask.
    """
    masks, anything = (_table(ids > 0), _table(ids != 0))
    low = cameras.eyes_m.min(axis=0) - BEYOND_M
    high = cameras.eyes_m.max(axis=0) + BEYOND_M
    count = np.ceil((high - low) / COARSE_M).astype(np.int64)
    cells = np.argwhere(np.ones(count, dtype=bool))
    kept = np.zeros(len(cells), dtype=bool)
    _score(
        cells,
        low,
        COARSE_M,
        cameras.eyes_m,
        cameras.to_image,
        cameras.focal_px,
        masks,
        anything,
        True,
        kept,
    )
    cells = cells[kept]
    if not len(cells):
        return Grid(low, COARSE_M, np.zeros((1, 1, 1), dtype=bool))
    corner = cells.min(axis=0)
    low = low + corner * COARSE_M
    fine_m = COARSE_M / FINE
    steps = np.argwhere(np.ones((FINE,) * 3, dtype=bool))
    fine = ((cells - corner)[:, None] * FINE + steps).reshape(-1, 3)
    kept = np.zeros(len(fine), dtype=bool)
    _score(
        fine,
        low,
        fine_m,
        cameras.eyes_m,
        cameras.to_image,
        cameras.focal_px,
        masks,
        anything,
        False,
        kept,
    )
    filled = np.zeros((cells.max(axis=0) - corner + 1) * FINE, dtype=bool)
    filled[tuple(fine[kept].T)] = True
    return Grid(low, fine_m, filled)


def _table(there: Bool[np.ndarray, "views height width"]) -> Int[np.ndarray, "views rows columns"]:
    """Summed-area tables, with a row and a column of zeros ahead."""
    sums = there.cumsum(axis=1, dtype=np.int32).cumsum(axis=2, dtype=np.int32)
    return np.pad(sums, ((0, 0), (1, 0), (1, 0)))


# no_type_check: what Numba compiles has no annotations.
@njit(cache=True, nogil=True)
@no_type_check
def _count(table, x1, y1, x2, y2):
    height, width = table.shape[0] - 1, table.shape[1] - 1
    x1, y1, x2, y2 = max(x1, 0), max(y1, 0), min(x2, width), min(y2, height)
    return table[y2, x2] - table[y1, x2] - table[y2, x1] + table[y1, x1]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def pixel_of(matrix, x, y, z, height, width):
    """Row, column and depth in metres of a point in a view, whose `matrix` (3, 4) takes points to
    the image. The row is -1 for a point behind the camera or beyond the image."""
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
def _score(cells, low_m, cell_m, eyes_m, to_image, focal_px, masks, anything, any_mask, kept):
    views, height, width = masks.shape[0], masks.shape[1] - 1, masks.shape[2] - 1
    for_it = np.log((1 - MISSED) / (1 - BACKGROUND))
    against = np.log(MISSED / BACKGROUND)
    for i in range(len(cells)):
        x = low_m[0] + (cells[i, 0] + 0.5) * cell_m
        y = low_m[1] + (cells[i, 1] + 0.5) * cell_m
        z = low_m[2] + (cells[i, 2] + 0.5) * cell_m
        odds, seen = PRIOR, 0
        for view in range(views):
            if not any_mask:
                a, b, c = x - eyes_m[view, 0], y - eyes_m[view, 1], z - eyes_m[view, 2]
                if a * a + b * b + c * c < CLEAR_M * CLEAR_M:
                    odds = -1e9
                    break
            row, column, depth = pixel_of(to_image[view], x, y, z, height, width)
            if row < 0:
                continue
            # A coarse cell's corner is 0.87 edges from its centre.
            reach = 0.87 if any_mask else 0.5
            radius = int(reach * cell_m * focal_px[view] / depth + 0.5)
            box = column - radius, row - radius, column + radius + 1, row + radius + 1
            if _count(anything[view], box[0], box[1], box[2], box[3]) == 0:
                odds += against
            elif any_mask or _count(masks[view], column, row, column + 1, row + 1):
                odds += for_it
                seen += 1
        kept[i] = odds > 0 and seen >= 2

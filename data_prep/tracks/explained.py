"""The share of each mask whose rays pass through the visual hull of each cluster of masks."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from data_prep.tracks.voxels import Cameras, Grid, pixel_of

VIEWS_AT_LEAST = 2
"""Smallest number of views, other than the mask's own, that show the cluster in a cell of its
hull."""
PAST = 0.3
"""Largest share of views that see past a cell of a hull; half a view more is allowed."""
EVERY = 2
"""Step between the rows and columns whose rays are followed."""


def explained(
    ids: Int[np.ndarray, "views height width"],
    near: Int[np.ndarray, "views height width"],
    labels: Int[np.ndarray, " masks"],
    cameras: Cameras,
    grid: Grid,
) -> Float[np.ndarray, "masks clusters"]:
    """Share of the rays of each mask that meet the hull of each cluster.

    A cell is in the hull if at least two views show the cluster there and few see background.
    Masks of other clusters are no evidence, since they may be in front. The hull of a mask's own
    cluster is computed without the mask's view. `near` are the ids with masks widened by a pixel.
    """
    clusters = int(labels.max()) + 1
    full = np.concatenate([[-1], labels]).astype(np.int32)
    shown = np.where(ids < 0, -2, full[np.maximum(near, 0)]).astype(np.int32)
    cells = np.argwhere(grid.filled)
    row = np.full(grid.filled.shape, -1, dtype=np.int32)
    row[tuple(cells.T)] = np.arange(len(cells))
    own = np.zeros((len(cells), clusters), dtype=np.int16)
    past = np.zeros(len(cells), dtype=np.int16)
    _count(cells, shown, cameras.to_image, grid.low_m, grid.cell_m, own, past)
    met = np.zeros((len(labels), clusters))
    rays = np.zeros(len(labels))
    _follow(
        ids, shown, cameras.eyes_m, cameras.rays, grid.low_m, grid.cell_m, row, own, past, met, rays
    )
    return met / np.maximum(rays, 1)[:, None]


# no_type_check: what Numba compiles has no annotations.
@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _count(cells, shown, to_image, low_m, cell_m, own, past):
    views, height, width = shown.shape
    for i in range(len(cells)):
        x = low_m[0] + (cells[i, 0] + 0.5) * cell_m
        y = low_m[1] + (cells[i, 1] + 0.5) * cell_m
        z = low_m[2] + (cells[i, 2] + 0.5) * cell_m
        for view in range(views):
            line, column, _ = pixel_of(to_image[view], x, y, z, height, width)
            if line < 0:
                continue
            label = shown[view, line, column]
            if label == -1:
                past[i] += 1
            elif label >= 0:
                own[i, label] += 1


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _follow(ids, shown, eyes_m, rays, low_m, cell_m, row, own, past, met, count):
    views, height, width = ids.shape
    shape, clusters = row.shape, own.shape[1]
    passed = np.zeros(clusters, np.bool_)
    d = np.empty(3)
    for view in range(views):
        eye, r = eyes_m[view], rays[view]
        for y in range(0, height, EVERY):
            for x in range(0, width, EVERY):
                mask = ids[view, y, x] - 1
                if mask < 0:
                    continue
                label = shown[view, y, x]
                count[mask] += 1
                passed[:] = False
                length = 0.0
                near, far = 0.0, 1e9
                for axis in range(3):
                    d[axis] = r[axis, 0] * (x + 0.5) + r[axis, 1] * (y + 0.5) + r[axis, 2]
                    length += d[axis] * d[axis]
                    one = (low_m[axis] - eye[axis]) / d[axis]
                    two = one + shape[axis] * cell_m / d[axis]
                    near, far = max(near, min(one, two)), min(far, max(one, two))
                stride = 0.7 * cell_m / np.sqrt(length)
                t = near + 0.5 * stride
                last = -1
                while t < far:
                    i = int((eye[0] + t * d[0] - low_m[0]) / cell_m)
                    j = int((eye[1] + t * d[1] - low_m[1]) / cell_m)
                    k = int((eye[2] + t * d[2] - low_m[2]) / cell_m)
                    t += stride
                    if not (0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]):
                        continue
                    cell = row[i, j, k]
                    if cell < 0 or cell == last:
                        continue
                    last = cell
                    for other in range(clusters):
                        views_for = own[cell, other] - (1 if other == label else 0)
                        if views_for < VIEWS_AT_LEAST:
                            continue
                        if past[cell] <= PAST * (views_for + past[cell]) + 0.5:
                            passed[other] = True
                for other in range(clusters):
                    if passed[other]:
                        met[mask, other] += 1

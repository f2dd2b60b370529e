"""Computes the share of each mask's rays that pass through each cluster's visual hull."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from data_prep.tracks.rays import cell_at, direction_of, ids_at, span_of, votes_of
from data_prep.tracks.voxels import Cameras, Grid

LEAST_VIEWS = 2
"""Minimum number of views, other than the mask's, that must show the cluster in a hull cell."""
PAST = 0.3
"""Maximum share of views that see past a hull cell; half a view is added to the limit."""
EVERY = 2
"""Step between the rows and columns whose rays are followed."""


def explained(
    ids: Int[np.ndarray, "views height width"],
    near: Int[np.ndarray, "views height width"],
    labels: Int[np.ndarray, " masks"],
    cameras: Cameras,
    grid: Grid,
) -> Float[np.ndarray, "masks clusters"]:
    """Share of each mask's rays that meet each cluster's hull.

    A cell is in the hull if at least two views show the cluster there and few see background.
    Masks of other clusters do not count, since they may be in front. The hull of a mask's own
    cluster is computed without the mask's view. `near` are the ids after `widened`.
    """
    cells = np.argwhere(grid.filled)
    row_of_cell = np.full(grid.filled.shape, -1, dtype=np.int32)
    row_of_cell[tuple(cells.T)] = np.arange(len(cells))
    anywhere = np.full(ids.shape, np.inf, dtype=np.float32)
    shown = ids_at(cells, near, cameras, grid, anywhere)
    votes, past = votes_of(shown, labels), (shown == 0).sum(axis=1)
    met, rays = _follow(
        ids, labels, cameras.eyes_m, cameras.rays, grid.low_m, grid.cell_m, row_of_cell,
        _in_hull(votes, past), _in_hull(votes - 1, past),
    )  # fmt: skip
    return met / np.maximum(rays, 1)[:, None]


def _in_hull(
    votes: Int[np.ndarray, "cells clusters"], past: Int[np.ndarray, " cells"]
) -> Bool[np.ndarray, "cells clusters"]:
    """True for cells in a cluster's hull, by the views that show it there or see past it."""
    few = past[:, None] <= PAST * (votes + past[:, None]) + 0.5
    return np.asarray((votes >= LEAST_VIEWS) & few)


# no_type_check: functions compiled by Numba have no annotations.
@njit(cache=True, nogil=True)
@no_type_check
def _follow(ids, labels, eyes_m, rays, low_m, cell_m, row_of_cell, hulls, hulls_without):
    """Numbers of each mask's rays that meet each cluster's hull, and of all its rays;
    `hulls_without` are the hulls computed without one view."""
    views, height, width = ids.shape
    clusters = hulls.shape[1]
    met, count = np.zeros((len(labels), clusters)), np.zeros(len(labels))
    passed = np.zeros(clusters, np.bool_)
    for view, half_y, half_x in np.ndindex((views, -(-height // EVERY), -(-width // EVERY))):
        y, x = half_y * EVERY, half_x * EVERY
        mask = ids[view, y, x] - 1
        if mask < 0:
            continue
        count[mask] += 1
        passed[:] = False
        eye, direction = eyes_m[view], direction_of(rays[view], y, x)
        near, far, length = span_of(eye, direction, low_m, cell_m, row_of_cell.shape)
        stride = 0.7 * cell_m / length
        t = near + 0.5 * stride
        last = -1
        while t < far:
            cell = cell_at(eye, direction, t, low_m, cell_m, row_of_cell.shape)
            t += stride
            row = row_of_cell[cell] if cell[0] >= 0 else -1
            if row < 0 or row == last:
                continue
            last = row
            for other in range(clusters):
                own = other == labels[mask]
                passed[other] |= hulls_without[row, other] if own else hulls[row, other]
        met[mask] += passed
    return met, count

"""Merges small clusters of masks into larger ones whose visual hulls cover their rays."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from data_prep.tracks.carving import (
    Cameras,
    Grid,
    cell_at,
    direction_of,
    ids_at,
    span_of,
    votes_of,
)
from data_prep.tracks.clusters import CLASS_ERROR, class_odds, main_classes

LEAST_VIEWS = 2
"""Minimum number of views, other than the mask's, that must show the cluster in a hull cell."""
PAST = 0.3
"""Maximum share of views that see past a hull cell; half a view is added to the limit."""
EVERY = 2
"""Step between the rows and columns whose rays are followed."""
ENOUGH = 0.6
"""Share of a mask's rays that must meet a cluster's hull for the hull to favour joining."""
HULL, CLASS, PAIRS, SAME_VIEWS = 4.0, 1.0, 2.0, -2.0
"""Weights of the terms of the gain: hulls, classes, mean pair weight, and common views."""
FEW = 6.0
"""Gain of joining a cluster of one mask to any other cluster, since most objects are visible more
often; for a cluster of n masks, the gain is divided by n."""


def hull_coverage(
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


def merge_clusters(
    labels: Int[np.ndarray, " masks"],
    share: Float[np.ndarray, "masks clusters"],
    weights: Float[np.ndarray, "masks masks"],
    mask_view: Int[np.ndarray, " masks"],
    mask_class: Int[np.ndarray, " masks"],
) -> Int[np.ndarray, " masks"]:
    """Merge each cluster, the smallest first, into the larger one with the largest positive gain.

    With the mean share s of the smaller cluster's rays that meet the larger cluster's hull, the
    gain is the sum of

    - HULL times (s - ENOUGH) / (1 - ENOUGH) if s is above ENOUGH, else HULL times 3 (s - ENOUGH),
    - CLASS times the log-odds of the classes,
    - PAIRS times the mean weight of pairs of masks in different views,
    - SAME_VIEWS times the share of the smaller cluster's views that show both clusters, and
    - FEW divided by the smaller cluster's number of masks.
    """
    count = int(labels.max()) + 1
    size = np.bincount(labels, minlength=count)
    masks_in = np.zeros((count, int(mask_view.max()) + 1), dtype=np.int64)
    np.add.at(masks_in, (labels, mask_view), 1)
    member = np.eye(count)[labels]
    between = np.where(mask_view[:, None] == mask_view, 0.0, weights)
    mean = member.T @ between @ member / np.maximum(size[:, None] * size, 1)
    main = main_classes(labels, mask_class)
    equal, unequal = class_odds(mask_class, CLASS_ERROR)
    into = np.arange(count)
    for k in np.argsort(size, kind="stable").tolist():
        own = labels == k
        open_to = (into == np.arange(count)) & (size >= max(2, size[k]))
        open_to[k] = False
        above = (share[own].mean(axis=0) - ENOUGH) / (1 - ENOUGH)
        alike = (mask_class[own][:, None] == main).mean(axis=0)
        common = ((masks_in[k] > 0) & (masks_in > 0)).sum(axis=1) / (masks_in[k] > 0).sum()
        gain = (
            HULL * np.where(above > 0, above, 3 * above * (1 - ENOUGH))
            + CLASS * (alike * equal + (1 - alike) * unequal)
            + PAIRS * mean[k]
            + SAME_VIEWS * common
            + FEW / size[k]
        )
        gain[~open_to] = -np.inf
        best = int(gain.argmax())
        if gain[best] > 0:
            into[k] = best
            masks_in[best] += masks_in[k]
            size[best] += size[k]
    while (into[into] != into).any():
        into = into[into]
    joined: Int[np.ndarray, " masks"] = np.unique(into[labels], return_inverse=True)[1]
    return joined

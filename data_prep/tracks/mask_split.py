"""Splits masks that show several objects, if other views distinguish these objects."""

import numpy as np
from jaxtyping import Int
from scipy import ndimage

from data_prep.tracks.carving import Cameras, Grid, Surface, votes_of, widened
from data_prep.tracks.cluster_merge import hull_coverage

LEAST_CELLS = 4
"""Minimum number of cells that each part of a mask must show."""
SHOWN = 0.5
"""Minimum share, shown by the part, of those cells of its cluster that the view sees."""
PART = 0.03
"""Minimum share of a mask's cells in each part."""
OTHERS = 2
"""Number of views, other than the mask's, that must agree on a cell's cluster."""
OWN, OTHER = 0.75, 0.6
"""Maximum share of a part's rays that meet the hull of the mask's cluster, and minimum share that
meet the hull of the part's cluster."""
SPECK = 5e-4
"""Share of an image that a part, or a cluster of one mask, must exceed."""

Split = list[tuple[int, int]]
"""Pairs of a mask and a second cluster that the mask shows."""


def split_masks(
    full: Int[np.ndarray, "views rows columns"],
    step: int,
    seen: Surface,
    labels: Int[np.ndarray, " masks"],
    mask_view: Int[np.ndarray, " masks"],
    cameras: Cameras,
    grid: Grid,
) -> tuple[Int[np.ndarray, "views rows columns"], Split]:
    """Cut masks that show several clusters into parts.

    A part is kept if its rays meet the hull of its own cluster, but not the hull of the mask's
    cluster, which might be behind the part.

    Args:
        full: Images of ids at full size; `cameras` sees every `step`-th row and column.

    Returns:
        The images, and the pairs whose parts are kept: part k gets the k-th id after the last.
    """
    split = find_merged(seen.shown, labels, mask_view)
    if not split:
        return full, []
    parted = cut(full, step, split, seen, labels, mask_view, cameras, grid)
    ids = np.ascontiguousarray(parted[:, ::step, ::step])
    own = np.array([labels[mask] for mask, _ in split])
    share = hull_coverage(ids, widened(ids), np.concatenate([labels, own]), cameras, grid)
    rows, others = len(labels) + np.arange(len(split)), np.array([other for _, other in split])
    pixels = np.bincount(parted[parted > 0], minlength=rows[-1] + 2)[rows + 1]
    kept = (share[rows, own] <= OWN) & (share[rows, others] >= OTHER)
    kept &= pixels > SPECK * full[0].size
    new_id = np.arange(rows[-1] + 2)
    new_id[rows + 1] = np.where(kept, len(labels) + np.cumsum(kept), [k + 1 for k, _ in split])
    parted = np.where(parted > 0, new_id[np.maximum(parted, 0)], parted).astype(full.dtype)
    return parted, [pair for pair, keep in zip(split, kept, strict=True) if keep]


def find_merged(
    shown: Int[np.ndarray, "cells views"],
    labels: Int[np.ndarray, " masks"],
    mask_view: Int[np.ndarray, " masks"],
) -> Split:
    """Find masks that show a second cluster, which has no separate mask in their view.

    According to the other views, most of the cluster's cells that the view sees must lie in this
    mask; the mask must also show cells of its own cluster.
    """
    votes = votes_of(shown, labels)
    present = np.zeros((votes.shape[1], shown.shape[1]), dtype=bool)
    present[labels, mask_view] = True
    found = []
    for mask, (view, own) in enumerate(zip(mask_view.tolist(), labels.tolist(), strict=True)):
        inside = shown[:, view] == mask + 1
        if inside.sum() < 2 * LEAST_CELLS:
            continue
        # Take all cells that the view sees, without this mask's own vote.
        rows = np.flatnonzero(shown[:, view] >= 0)
        others = votes[rows].copy()
        others[inside[rows], own] -= 1
        owner = np.where(others.max(axis=1) >= OTHERS, others.argmax(axis=1), -1)
        seen = np.bincount(owner[owner >= 0], minlength=votes.shape[1])
        part = np.bincount(owner[(owner >= 0) & inside[rows]], minlength=votes.shape[1])
        enough = max(LEAST_CELLS, PART * part.sum())
        second = (part >= enough) & (part >= SHOWN * seen) & ~present[:, view]
        if part[own] >= enough:
            found += [(mask, other) for other in np.flatnonzero(second).tolist()]
    return found


def cut(
    full: Int[np.ndarray, "views rows columns"],
    step: int,
    split: Split,
    seen: Surface,
    labels: Int[np.ndarray, " masks"],
    mask_view: Int[np.ndarray, " masks"],
    cameras: Cameras,
    grid: Grid,
) -> Int[np.ndarray, "views rows columns"]:
    """Images of ids in which each part of a mask has a separate id. A pixel belongs to the part of
    the nearest projected cell."""
    full = full.copy()
    votes = votes_of(seen.shown, labels)
    number = len(labels)
    for mask in dict.fromkeys(mask for mask, _ in split):
        view = int(mask_view[mask])
        parts = [int(labels[mask]), *(other for k, other in split if k == mask)]
        rows = np.flatnonzero(seen.shown[:, view] == mask + 1)
        others = votes[rows].copy()
        others[:, parts[0]] -= 1
        owner = np.array(parts)[others[:, parts].argmax(axis=1)]
        use = others[np.arange(len(rows)), owner] >= OTHERS
        points = grid.low_m + (seen.cells[rows[use]] + 0.5) * grid.cell_m
        projected = points @ cameras.to_image[view, :, :3].T + cameras.to_image[view, :, 3]
        height, width = full.shape[1] // step + 1, full.shape[2] // step + 1
        pixels = (projected[:, :2] / projected[:, 2:]).astype(int)
        x, y = pixels.clip(0, [width - 1, height - 1]).T
        seeds = np.full((height, width), -1, dtype=np.int64)
        seeds[y, x] = owner[use]
        nearest = ndimage.distance_transform_edt(
            seeds < 0, return_distances=False, return_indices=True
        )
        y, x = np.nonzero(full[view] == mask + 1)
        part_of = seeds[tuple(nearest[:, y // step, x // step])]
        for other in parts[1:]:
            number += 1
            mine = part_of == other
            full[view, y[mine], x[mine]] = number
    return full

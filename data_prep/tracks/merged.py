"""Splits masks that show several objects, where the other views tell these apart."""

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from data_prep.tracks.explained import explained
from data_prep.tracks.rays import widened
from data_prep.tracks.voxels import Cameras, Grid

CELLS = 4
"""Least number of cells that each part shows."""
SHOWN = 0.5
"""Least share of a part's cells seen by the view, of all cells of its cluster seen by the view."""
PART = 0.03
"""Least share of a mask's cells that a part has."""
OTHERS = 2
"""Views, other than the mask's own, that must agree on the cluster of a cell."""

OWN, OTHER = 0.75, 0.6
"""Largest share of a part's rays that meet the hull of the mask's own cluster, and least share of
those that meet the hull of the part's."""
SPECK = 5e-4
"""Share of an image that a part, or a mask that joins no other, must exceed."""

Split = list[tuple[int, int]]
"""Pairs of a mask and another cluster that it shows as well as its own."""


def split_merged(
    full: Int[np.ndarray, "views rows columns"],
    step: int,
    cells: Int[np.ndarray, "cells 3"],
    shown: Int[np.ndarray, "cells views"],
    labels: Int[np.ndarray, " masks"],
    mask_view: Int[np.ndarray, " masks"],
    cameras: Cameras,
    grid: Grid,
) -> tuple[Int[np.ndarray, "views rows columns"], Split]:
    """Cut masks of several clusters into parts, one per pair returned, with ids after the last.

    A part must be explained by the hull of its own cluster and not by that of its mask's, which
    else may hide the former. `full` are the images of ids, of which every `step`-th row and column
    belongs to `cameras`.
    """
    split = find_merged(shown, labels, mask_view)
    if not split:
        return full, []
    parted = cut(full, step, split, shown, cells, labels, mask_view, cameras, grid)
    ids = np.ascontiguousarray(parted[:, ::step, ::step])
    own = np.array([labels[mask] for mask, _ in split])
    share = explained(ids, widened(ids), np.concatenate([labels, own]), cameras, grid)
    rows, others = len(labels) + np.arange(len(split)), np.array([other for _, other in split])
    pixels = np.bincount(parted[parted > 0], minlength=rows[-1] + 2)[rows + 1]
    kept = (share[rows, own] <= OWN) & (share[rows, others] >= OTHER)
    kept &= pixels > SPECK * full[0].size
    back = np.arange(rows[-1] + 2)
    back[rows + 1] = np.where(kept, len(labels) + np.cumsum(kept), [one + 1 for one, _ in split])
    parted = np.where(parted > 0, back[np.maximum(parted, 0)], parted).astype(full.dtype)
    return parted, [pair for pair, keep in zip(split, kept, strict=True) if keep]


def owners(
    shown: Int[np.ndarray, "cells views"], labels: Int[np.ndarray, " masks"]
) -> Int[np.ndarray, "cells clusters"]:
    """Number of views that show each cluster in each cell."""
    votes = np.zeros((len(shown), int(labels.max()) + 1), dtype=np.int32)
    rows, views = np.nonzero(shown > 0)
    np.add.at(votes, (rows, labels[shown[rows, views] - 1]), 1)
    return votes


def find_merged(
    shown: Int[np.ndarray, "cells views"],
    labels: Int[np.ndarray, " masks"],
    mask_view: Int[np.ndarray, " masks"],
) -> Split:
    """Find masks that show a second cluster, which has no mask of its own in their view.

    Of the cluster's cells, as the other views have them, the view must see most in this mask, and
    the mask must show cells of its own cluster, too.
    """
    votes = owners(shown, labels)
    present = np.zeros((votes.shape[1], shown.shape[1]), dtype=bool)
    present[labels, mask_view] = True
    found = []
    for mask, (view, own) in enumerate(zip(mask_view.tolist(), labels.tolist(), strict=True)):
        inside = shown[:, view] == mask + 1
        if inside.sum() < 2 * CELLS:
            continue
        # All cells that the view sees; this mask's vote does not count.
        rows = np.flatnonzero(shown[:, view] >= 0)
        others = votes[rows].copy()
        others[inside[rows], own] -= 1
        owner = np.where(others.max(axis=1) >= OTHERS, others.argmax(axis=1), -1)
        seen = np.bincount(owner[owner >= 0], minlength=votes.shape[1])
        part = np.bincount(owner[(owner >= 0) & inside[rows]], minlength=votes.shape[1])
        enough = max(CELLS, PART * part.sum())
        second = (part >= enough) & (part >= SHOWN * seen) & ~present[:, view]
        if part[own] >= enough:
            found += [(mask, other) for other in np.flatnonzero(second).tolist()]
    return found


def cut(
    full: Int[np.ndarray, "views rows columns"],
    step: int,
    split: Split,
    shown: Int[np.ndarray, "cells views"],
    cells: Int[np.ndarray, "cells 3"],
    labels: Int[np.ndarray, " masks"],
    mask_view: Int[np.ndarray, " masks"],
    cameras: Cameras,
    grid: Grid,
) -> Int[np.ndarray, "views rows columns"]:
    """Give each part an id of its own. A pixel goes to the cluster whose cell projects nearest."""
    full = full.copy()
    votes = owners(shown, labels)
    number = len(labels)
    for mask in dict.fromkeys(mask for mask, _ in split):
        view = int(mask_view[mask])
        parts = [int(labels[mask]), *(other for one, other in split if one == mask)]
        rows = np.flatnonzero(shown[:, view] == mask + 1)
        others = votes[rows].copy()
        others[:, parts[0]] -= 1
        owner = np.array(parts)[others[:, parts].argmax(axis=1)]
        use = others[np.arange(len(rows)), owner] >= OTHERS
        points = grid.low_m + (cells[rows[use]] + 0.5) * grid.cell_m
        pixels = _project(points, cameras.to_image[view])
        height, width = full.shape[1] // step + 1, full.shape[2] // step + 1
        seeds = np.full((height, width), -1, dtype=np.int64)
        places = pixels.astype(int).clip(0, [width - 1, height - 1])
        seeds[places[:, 1], places[:, 0]] = owner[use]
        nearest = ndimage.distance_transform_edt(
            seeds < 0, return_distances=False, return_indices=True
        )
        y, x = np.nonzero(full[view] == mask + 1)
        near = seeds[tuple(nearest[:, y // step, x // step])]
        for other in parts[1:]:
            number += 1
            mine = near == other
            full[view, y[mine], x[mine]] = number
    return full


def _project(
    points_m: Float[np.ndarray, "points 3"], to_image: Float[np.ndarray, "3 4"]
) -> Float[np.ndarray, "points 2"]:
    """Pixels of points in front of a camera."""
    spot = points_m @ to_image[:, :3].T + to_image[:, 3]
    return spot[:, :2] / spot[:, 2:]

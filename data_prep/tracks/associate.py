"""Groups the masks of single frames by object, using only cameras, masks and classes.

Correlation clustering (`clusters.py`) maximises the sum, over pairs of masks in the same cluster,
of the log-odds that both show the same object, measured at the grid cells that both views see
(`carving.py`). Clustering alternates with space carving (Kutulakos and Seitz, "A theory of shape by
space carving", IJCV 2000), which compares clusters instead of colours: a cell in which views see
different clusters, or background, is emptied. Masks that show several objects are split on the way
(`split_masks`). At the end, masks that share few cells with others join the cluster whose visual
hull covers them, and masks that are still alone are merged by their directions and sizes
(`merging.py`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from data_prep.tracks.carving import (
    Cameras,
    Grid,
    Surface,
    cameras_of,
    fill,
    surface,
    votes_of,
    widened,
)
from data_prep.tracks.clusters import cluster, id_odds, main_classes, pair_weights
from data_prep.tracks.merging import discs_of, hull_coverage, merge_clusters, merge_singletons

STEP = 3
"""Step between the rows and columns used, for images whose longer side is 480 pixels; the step is
proportional to that side."""
ROUNDS, STRICT = 7, 2
"""Number of rounds of clustering and carving, and the round from which cells need two views that
agree."""
AGREE = 0.45
"""Minimum share of a filled cell's views that must show the same cluster."""
SPLIT = (3, 5)
"""Rounds in which merged masks are split."""
JOINS = 4
"""Maximum number of passes in which small clusters join larger ones."""
UNKNOWN = -1
"""Pixel value where the content is unknown."""
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


class FrameMasks(NamedTuple):
    """Masks of all frames of a room."""

    ids: Int[np.ndarray, "views height width"]
    """int32: k + 1 for mask k, 0 for background, -1 where the content is unknown."""
    mask_class: Int[np.ndarray, " masks"]

    @property
    def mask_view(self) -> Int[np.ndarray, " masks"]:
        """The view of each mask; 0 for a mask without pixels."""
        found = np.zeros(len(self.mask_class) + 1, dtype=np.int64)
        for view, image in enumerate(self.ids):
            found[np.unique(np.maximum(image, 0))] = view
        return found[1:]


class Tracks(NamedTuple):
    """Objects that the masks show."""

    ids: Int[np.ndarray, "views height width"]
    """int32: k + 1 for object k, 0 for background, -1 where the content is unknown."""
    object_class: Int[np.ndarray, " objects"]
    """The most frequent class among an object's masks."""


def associate(
    masks: FrameMasks,
    world_to_camera: Float[np.ndarray, "views 4 4"],
    intrinsics: Float[np.ndarray, "views 3 3"],
    given: Int[np.ndarray, " masks"] | None = None,
) -> Tracks:
    """Find the object that each mask shows.

    Args:
        world_to_camera: Poses with OpenCV axes, in metres; the direction of up does not matter.
        given: The masks' original ids. If the ids are consistent across views (`id_odds`), they are
        used as evidence, and no mask is split: correct ids are kept, others are repaired.
    """
    if not len(masks.mask_class):
        return Tracks(np.minimum(masks.ids, 0), masks.mask_class)
    parts, labels = _labels(masks, world_to_camera, intrinsics)
    speck = SPECK
    if given is not None:
        odds = id_odds(given, labels[: len(given)], masks.mask_view)
        if odds is not None:
            parts, labels = _labels(masks, world_to_camera, intrinsics, odds)
            speck = 0.0
    pixels = np.bincount(parts.ids[parts.ids > 0], minlength=len(labels) + 1)[1:]
    size, area = np.bincount(labels), np.bincount(labels, pixels)
    kept = (area > 0) & ((size > 1) | (area > speck * parts.ids[0].size))
    number = np.where(kept, np.cumsum(kept), UNKNOWN)
    object_of_id = np.concatenate([[0], number[labels]])
    ids = np.where(parts.ids < 0, UNKNOWN, object_of_id[np.maximum(parts.ids, 0)]).astype(np.int32)
    return Tracks(ids, main_classes(labels, parts.mask_class)[kept])


def _labels(
    masks: FrameMasks,
    world_to_camera: np.ndarray,
    intrinsics: np.ndarray,
    odds: np.ndarray | None = None,
) -> tuple[FrameMasks, Int[np.ndarray, " masks"]]:
    """The masks, after merged masks are split, and each mask's cluster.

    `odds`, (masks, masks), are the log-odds of `id_odds`, added to the weights of pairs. With them,
    masks are neither split nor joined by hulls.
    """
    step = max(1, round(STEP * max(masks.ids.shape[1:]) / 480))
    cameras = cameras_of(world_to_camera, intrinsics, step)
    ids = np.ascontiguousarray(masks.ids[:, ::step, ::step])
    near, view, classes = widened(ids), masks.mask_view, masks.mask_class
    grid = fill(near, cameras)
    for number in range(ROUNDS):
        seen = surface(ids, near, cameras, grid)
        weights = pair_weights(seen.shown, view, classes) + (0.0 if odds is None else odds)
        labels = cluster(weights)
        split: Split = []
        if odds is None and number in SPLIT:
            full, split = split_masks(masks.ids, step, seen, labels, view, cameras, grid)
        if split:
            main = main_classes(labels, classes)[[other for _, other in split]]
            masks = FrameMasks(full, np.concatenate([classes, main]))
            ids = np.ascontiguousarray(masks.ids[:, ::step, ::step])
            near, classes = widened(ids), masks.mask_class
            view = np.concatenate([view, view[[mask for mask, _ in split]]])
        elif number < ROUNDS - 1:
            # Cells whose views show different clusters, or background, are emptied.
            most, views = votes_of(seen.shown, labels).max(axis=1), (seen.shown >= 0).sum(axis=1)
            wrong = (views >= 3) & (most < AGREE * views)
            if number >= STRICT:
                wrong |= most < 2
            grid.filled[tuple(seen.cells[wrong].T)] = False
    for _ in range(JOINS if odds is None else 0):
        share = hull_coverage(ids, near, labels, cameras, grid)
        joined = merge_clusters(labels, share, weights, view, classes)
        if np.array_equal(joined, labels):
            break
        labels = joined
    if odds is None:
        labels = merge_singletons(labels, discs_of(ids, view, cameras), view, classes)
    return masks, labels


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
    split = _find_merged(seen.shown, labels, mask_view)
    if not split:
        return full, []
    parted = _cut(full, step, split, seen, labels, mask_view, cameras, grid)
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


def _find_merged(
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


def _cut(
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

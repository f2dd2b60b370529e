"""Groups the masks of single frames by object, using only cameras, masks and classes.

Correlation clustering (`clusters.py`) maximises the sum, over pairs of masks in the same cluster,
of the log-odds that both show the same object, measured at the grid cells that both views see
(`carving.py`). Clustering alternates with space carving (Kutulakos and Seitz, "A theory of shape by
space carving", IJCV 2000), which compares clusters instead of colours: a cell in which views see
different clusters, or background, is emptied. Masks that show several objects are split on the way
(`mask_split.py`). At the end, masks that share few cells with others join the cluster whose visual
hull covers them (`cluster_merge.py`), and masks that are still alone are merged by their directions
and sizes (`singleton_merge.py`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from data_prep.tracks.carving import (
    Grid,
    Surface,
    cameras_of,
    fill,
    first_hits,
    surface,
    votes_of,
    widened,
)
from data_prep.tracks.cluster_merge import hull_coverage, merge_clusters
from data_prep.tracks.clusters import cluster, id_odds, main_classes, pair_weights
from data_prep.tracks.mask_split import SPECK, Split, split_masks
from data_prep.tracks.singleton_merge import discs_of, merge_singletons

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
        depth = first_hits(ids, cameras, grid)
        seen = surface(near, cameras, grid, depth)
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
            _carve(grid, seen, labels, number >= STRICT)
    for _ in range(JOINS if odds is None else 0):
        share = hull_coverage(ids, near, labels, cameras, grid)
        joined = merge_clusters(labels, share, weights, view, classes)
        if np.array_equal(joined, labels):
            break
        labels = joined
    if odds is None:
        labels = merge_singletons(labels, discs_of(ids, view, cameras), view, classes)
    return masks, labels


def _carve(grid: Grid, seen: Surface, labels: np.ndarray, strict: bool) -> None:
    """Empty the cells whose views show different clusters, or background."""
    most, views = votes_of(seen.shown, labels).max(axis=1), (seen.shown >= 0).sum(axis=1)
    wrong = (views >= 3) & (most < AGREE * views)
    if strict:
        wrong |= most < 2
    grid.filled[tuple(seen.cells[wrong].T)] = False

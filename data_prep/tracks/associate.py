"""Finds the objects that masks of single frames show, from cameras, masks and classes alone.

The objective is that of `clusters.py`: the sum, over pairs of masks in one cluster, of the
log-odds that they show one object (`affinity.py`), judged at the cells of a grid that both views
see. Which cells are filled is found in turns with the clusters, as in space carving (Kutulakos and
Seitz, "A theory of shape by space carving", IJCV 2000), with clusters in place of colours: a cell
in which views see different objects, or background, is empty. Last, masks that share few cells
with others join the cluster whose visual hull explains them (`leftovers.py`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from data_prep.tracks.affinity import pair_weights
from data_prep.tracks.clusters import cluster
from data_prep.tracks.explained import explained
from data_prep.tracks.leftovers import join_leftovers
from data_prep.tracks.rays import first_hits, surface
from data_prep.tracks.voxels import Grid, cameras_of, fill

STEP = 3
"""Every how many rows and columns of a picture of 480 pixels are used."""
WIDEN_PX = 1.5
"""Sampled pixels by which masks are widened where views are compared: outlines, cells and poses
are not exact."""
ROUNDS, STRICT = 6, 2
"""Rounds of clustering and carving; from round STRICT on, cells need two views that agree."""
AGREE = 0.45
"""Share of the views of a filled cell that must show one cluster there."""
JOINS = 4


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
    """The class of most of an object's masks."""


def associate(
    masks: FrameMasks,
    world_to_camera: Float[np.ndarray, "views 4 4"],
    intrinsics: Float[np.ndarray, "views 3 3"],
) -> Tracks:
    """Find the object that each mask shows.

    Poses have OpenCV axes and metres; which way is up does not matter.
    """
    if not len(masks.mask_class):
        return Tracks(np.minimum(masks.ids, 0), masks.mask_class)
    labels = _labels(masks, world_to_camera, intrinsics)
    of_id = np.concatenate([[0], labels + 1])
    ids = np.where(masks.ids < 0, -1, of_id[np.maximum(masks.ids, 0)]).astype(np.int32)
    classes = [np.bincount(masks.mask_class[labels == k]).argmax() for k in range(labels.max() + 1)]
    return Tracks(ids, np.array(classes, dtype=np.int64))


def _labels(
    masks: FrameMasks, world_to_camera: np.ndarray, intrinsics: np.ndarray
) -> Int[np.ndarray, " masks"]:
    """Number of the object, from 0, that each mask shows."""
    view, classes = masks.mask_view, masks.mask_class
    step = max(1, round(STEP * max(masks.ids.shape[1:]) / 480))
    ids = np.ascontiguousarray(masks.ids[:, ::step, ::step])
    near = _widened(ids)
    cameras = cameras_of(world_to_camera, intrinsics, step)
    grid = fill(ids, cameras)
    for number in range(ROUNDS):
        depth = first_hits(ids, cameras, grid)
        cells, shown = surface(near, cameras, grid, depth)
        weights = pair_weights(shown, view, classes)
        labels = cluster(weights)
        if number < ROUNDS - 1:
            _carve(grid, cells, shown, labels, number >= STRICT)
    for _ in range(JOINS):
        share = explained(ids, near, labels, cameras, grid)
        joined = join_leftovers(labels, share, weights, view, classes)
        if np.array_equal(joined, labels):
            break
        labels = joined
    return labels


def _widened(ids: np.ndarray) -> np.ndarray:
    """Widen masks into the background by `WIDEN_PX`."""
    wide = ids.copy()
    for image, new in zip(ids, wide, strict=True):
        if (image > 0).any():
            far, (rows, columns) = ndimage.distance_transform_edt(image <= 0, return_indices=True)
            rim = (image == 0) & (far <= WIDEN_PX)
            new[rim] = image[rows[rim], columns[rim]]
    return wide


def _carve(
    grid: Grid, cells: np.ndarray, shown: np.ndarray, labels: np.ndarray, strict: bool
) -> None:
    """Empty the cells whose views show different clusters, or background."""
    votes = np.zeros((len(cells), labels.max() + 1), dtype=np.int32)
    rows, views = np.nonzero(shown > 0)
    np.add.at(votes, (rows, labels[shown[rows, views] - 1]), 1)
    most, seen = votes.max(axis=1), (shown >= 0).sum(axis=1)
    wrong = (seen >= 3) & (most < AGREE * seen)
    if strict:
        wrong |= most < 2
    grid.filled[tuple(cells[wrong].T)] = False

"""Lookalikes: objects of a data set that have nearly the same shape, seen from other sides."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist

from sceneprior.core.geometry.turns import quarter_rotation, turn_grids
from sceneprior.lifted.prototypes import POSES, pooled, turn_of, turned_extents

MOST = 8
"""Maximum number of lookalikes of an object."""
FARTHEST = 0.25
"""Largest distance of two lookalikes; see `lookalikes`."""
SIZE_WEIGHT = 0.3
"""Weight of the L1 distance of log extents; see `lookalikes`."""


class Lookalike(NamedTuple):
    """An object that looks like another one after mirroring and turning."""

    item: int
    quarters: int
    """Quarter turns about +y, after mirroring."""
    mirrored: bool
    """True if x is reversed first."""


def moved_vectors(
    vectors: Float[np.ndarray, "vectors 3"], quarters: int, mirrored: bool
) -> Float[np.ndarray, "vectors 3"]:
    """Mirror and turn vectors as `turn_grids` does grids."""
    mirror = np.array([-1 if mirrored else 1, 1, 1], vectors.dtype)
    return (mirror * vectors) @ quarter_rotation(quarters).T.astype(vectors.dtype)


def lookalikes(
    grids: Bool[np.ndarray, "objects x y z"],
    sizes_m: Float[np.ndarray, "objects 3"],
    object_class: Int[np.ndarray, " objects"],
) -> list[list[Lookalike]]:
    """For each object, the nearest objects of its class, at most `MOST`, nearest first; the object
    itself, mirrored or turned, may be among them.

    The distance of two objects is the mean difference of their grids, at half the resolution, plus
    `SIZE_WEIGHT` times the L1 distance of their log extents. An object with an empty grid has no
    lookalikes.
    """
    found: list[list[Lookalike]] = [[] for _ in grids]
    filled = grids.any(axis=(1, 2, 3))
    for label in np.unique(object_class[filled]):
        items = np.flatnonzero((object_class == label) & filled)
        coarse = pooled(grids[items], grids.shape[1] // 2)
        flat, sizes = coarse.reshape(len(items), -1), np.log(sizes_m[items])
        apart = np.empty((len(items), len(items), POSES))
        for pose in range(POSES):
            moved = turn_grids(coarse, *turn_of(pose)).reshape(flat.shape)
            turned = turned_extents(sizes, pose)
            apart[..., pose] = cdist(flat, moved, "cityblock") / flat.shape[1]
            apart[..., pose] += SIZE_WEIGHT * cdist(sizes, turned, "cityblock")
        for row, item in enumerate(items):
            apart[row, row, 0] = np.inf  # without the object itself, unmoved
            nearest = np.argsort(apart[row], axis=None, kind="stable")[:MOST]
            found[item] = [
                Lookalike(int(items[other]), *turn_of(int(pose)))
                for other, pose in zip(*np.unravel_index(nearest, apart.shape[1:]), strict=True)
                if apart[row, other, pose] < FARTHEST
            ]
    return found

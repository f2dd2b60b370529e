"""Sizes and heights that repeat: clusters of training objects, for each prototype.

Real furniture repeats a limited number of models, and lifted boxes of the same model differ by a
few per cent. Objects of one prototype with similar extents are one entry, with their median
extents, the median height of their bottoms, and their number. An entry holds nothing about the
rooms in which its objects were found.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.lifted.prototypes import POSES, Prototypes
from sceneprior.lifted.rooms import PosedRooms

SIZES = 32
"""Maximum number of sizes of a prototype; the most frequent ones are kept."""
SAME_SIZE = 0.13
"""Largest difference between the log extents of two objects of one entry, along any axis. The value
gives the val rooms' sizes the highest likelihood
(docs/experiments/2026-11-25-sizes-that-repeat.md)."""
COMMON = 2
"""Number of objects that an entry must have, unless no entry of its prototype has as many. An
unusual size is more often an error of lifting than truly rare."""


def find_sizes(
    rooms: PosedRooms, prototypes: Prototypes, count: int
) -> tuple[
    Float[Tensor, "count sizes 3"], Float[Tensor, "count sizes"], Float[Tensor, "count sizes"]
]:
    """Extents of the entries of each prototype, in pose 0, heights of their bottoms, at least 0,
    both in metres, and their numbers of objects.

    Entries are clusters by complete linkage of the objects' log extents, cut at `SAME_SIZE`. A
    prototype without objects has one entry, its own extents on the floor. Unused rows have extents
    of 1 m and the number 0.

    Args:
        rooms: Furnished rooms with looks.
        prototypes: The prototypes of these looks.
        count: Length of the result, at least the number of prototypes.
    """
    from scipy.cluster.hierarchy import fcluster, linkage  # imported here: training only

    assert rooms.looks is not None
    looks = rooms.looks[rooms.is_object].numpy()
    centers_m, objects_m = rooms.boxes_m[rooms.is_object].double().split(3, dim=-1)
    heights_m = (centers_m - objects_m / 2)[:, 1].clamp(min=0).numpy()
    # Odd poses are turned by a quarter or three, which swaps x and z.
    objects_m = np.where(looks[:, None] % 2 == 1, objects_m.numpy()[:, ::-1], objects_m)
    found_m = torch.ones(count, SIZES, 3)
    bottoms_m, numbers = torch.zeros(2, count, SIZES)
    for row in np.flatnonzero(prototypes.object_class >= 0):
        own = looks // POSES == row
        own_m, own_bottoms_m = objects_m[own], heights_m[own]
        if len(own_m) < 2:
            if not len(own_m):
                own_m, own_bottoms_m = prototypes.sizes_m[row, None], np.zeros(1)
            entry = np.zeros(1, dtype=int)
        else:
            joined = linkage(np.log(own_m), "complete", "chebyshev")
            entry = fcluster(joined, SAME_SIZE, "distance") - 1
        number = np.bincount(entry)
        kept = np.argsort(-number, kind="stable")[:SIZES]
        kept = kept[number[kept] >= min(COMMON, number.max())]
        medians_m = [np.median(own_m[entry == each], axis=0) for each in kept]
        found_m[row, : len(kept)] = torch.from_numpy(np.stack(medians_m))
        for column, each in enumerate(kept):
            bottoms_m[row, column] = float(np.median(own_bottoms_m[entry == each]))
        numbers[row, : len(kept)] = torch.from_numpy(number[kept])
    return found_m, bottoms_m, numbers

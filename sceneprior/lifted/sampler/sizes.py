"""Sizes that repeat: clusters of the training objects' extents, for each prototype.

Real furniture repeats a limited number of models, and lifted boxes of the same model differ by a
few per cent. Objects of one prototype with similar extents are one entry, with their median extents
and their number. An entry holds only a size, and nothing about the rooms in which it was found.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.core.views import RoomBoxes
from sceneprior.lifted.prototypes import POSES, Prototypes

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
    rooms: RoomBoxes, prototypes: Prototypes, count: int
) -> tuple[Float[Tensor, "count sizes 3"], Float[Tensor, "count sizes"]]:
    """Extents of the entries of each prototype, in pose 0, in metres, and their numbers of objects.

    Entries are clusters by complete linkage of the objects' log extents, cut at `SAME_SIZE`. A
    prototype without objects has one entry, its own extents. Unused rows have extents of 1 m and
    the number 0.

    Args:
        rooms: Furnished rooms with looks.
        prototypes: The prototypes of these looks.
        count: Length of the result, at least the number of prototypes.
    """
    from scipy.cluster.hierarchy import fcluster, linkage  # imported here: training only

    assert rooms.looks is not None
    looks = rooms.looks[rooms.is_object].numpy()
    objects_m = rooms.boxes_m[rooms.is_object][:, 3:].numpy().astype(np.float64)
    # Odd poses are turned by a quarter or three, which swaps x and z.
    objects_m = np.where(looks[:, None] % 2 == 1, objects_m[:, ::-1], objects_m)
    found_m, numbers = torch.ones(count, SIZES, 3), torch.zeros(count, SIZES)
    for row in np.flatnonzero(prototypes.object_class >= 0):
        own_m = objects_m[looks // POSES == row]
        if len(own_m) < 2:
            own_m = own_m if len(own_m) else prototypes.sizes_m[row, None]
            entry = np.zeros(1, dtype=int)
        else:
            joined = linkage(np.log(own_m), "complete", "chebyshev")
            entry = fcluster(joined, SAME_SIZE, "distance") - 1
        number = np.bincount(entry)
        kept = np.argsort(-number, kind="stable")[:SIZES]
        kept = kept[number[kept] >= min(COMMON, number.max())]
        medians_m = [np.median(own_m[entry == each], axis=0) for each in kept]
        found_m[row, : len(kept)] = torch.from_numpy(np.stack(medians_m))
        numbers[row, : len(kept)] = torch.from_numpy(number[kept])
    return found_m, numbers

"""Statistics of the training rooms that a sampler is given before it is trained: rectangles, pairs
of classes that may intersect, exclusive prototypes, and the backs, fronts, sizes and heights of
prototypes.

Real furniture repeats a limited number of models, and lifted boxes of the same model differ by a
few per cent. Objects of one prototype with similar extents are one entry of its list of sizes, with
their median extents, the median height of their bottoms, and their number. An entry holds nothing
about the rooms in which its objects were found.
"""

import numpy as np
import torch
from jaxtyping import Float
from sklearn.mixture import GaussianMixture
from torch import Tensor

from sceneprior.core.boxes import QUARTERS
from sceneprior.lifted.prototypes import POSES, PosedRooms, Prototypes
from sceneprior.lifted.sampler.contents import exclusive
from sceneprior.lifted.sampler.network import RECTANGLES, SIZES, RoomSampler
from sceneprior.lifted.sampler.rooms import SamplerRooms, frames_of

SAME_SIZE = 0.13
"""Largest difference between the log extents of two objects of one entry, along any axis. The value
gives the val rooms' sizes the highest likelihood
(docs/experiments/2026-11-25-sizes-that-repeat.md)."""
COMMON = 2
"""Number of objects that an entry must have, unless no entry of its prototype has as many. An
unusual size is more often an error of lifting than truly rare."""
FAR_SIZE = np.log(2)
"""Largest difference between the log extents of an object and the medians of its prototype.
Objects that differ more are slabs, or two objects in one box, and give no size: they are errors of
lifting. If all differ more, the nearest remain."""
FRAMES = 8
"""Noisy rectangles per training room to which the mixture is fitted."""
LEAST_VARIANCE = 0.004
"""Added to the variances of the mixture of rectangles: 6 cm squared, or 6% of an extent squared.
With more, drawn rooms differ more in size than training rooms."""


def teach(sampler: RoomSampler, rooms: SamplerRooms) -> None:
    """Set the buffers of a fresh sampler from the training rooms: the encodings of looks, the
    mixture of rectangles, the classes that may be sampled, the pairs of classes that may intersect,
    exclusive prototypes, mean footprints, and the sizes, heights, backs and fronts of prototypes.
    """
    prototypes = rooms.prototypes
    looks = torch.from_numpy(prototypes.shown())
    sampler.look_shown[: len(looks)] = looks
    labels = torch.from_numpy(prototypes.object_class)
    sampler.look_class[: len(looks)] = labels.repeat_interleave(POSES)
    sampler.contents.teach(sampler.counts(rooms.rooms))
    sampler.may_meet.copy_(rooms.may_meet(len(sampler.may_meet)))
    here, posed = rooms.rooms.is_object, rooms.rooms.looks
    assert posed is not None
    counts = torch.zeros(len(posed), len(sampler.exclusive))
    sampler.exclusive.copy_(exclusive(counts.scatter_add_(1, posed // POSES, here.float())))
    areas_m2 = rooms.rooms.boxes_m[here][:, [3, 5]].prod(dim=-1)
    labels = rooms.rooms.object_class[here]
    sampler.footprints_m2.scatter_reduce_(0, labels, areas_m2, "mean", include_self=False)
    names = ("backs", "fronts", "front_confidence", "sizes_m", "bottoms_m", "size_counts")
    fronts = (rooms.backs + QUARTERS // 2) % QUARTERS
    sizes = find_sizes(rooms.rooms, prototypes)
    found = (rooms.backs, fronts, rooms.confidence, *sizes)
    for name, values in zip(names, found, strict=True):
        getattr(sampler, name)[: len(values)] = values
    generator = torch.Generator().manual_seed(0)
    furnished = here.any(dim=1)
    times = max(FRAMES, RECTANGLES // int(furnished.sum()))  # as many rows as components at least
    frames = torch.cat([frames_of(rooms.rooms, generator) for _ in range(times)])
    centre, extents = frames[furnished.repeat(times)].split(2, dim=-1)
    mixture = GaussianMixture(RECTANGLES, reg_covar=LEAST_VARIANCE, random_state=0).fit(
        torch.cat([centre, extents.log()], dim=-1).numpy()
    )
    for buffer, fitted in (
        (sampler.rectangle_logits, np.log(mixture.weights_)),
        (sampler.rectangle_means, mixture.means_),
        (sampler.rectangle_factors, np.linalg.cholesky(mixture.covariances_)),
    ):
        buffer.copy_(torch.from_numpy(fitted))


def find_sizes(
    rooms: PosedRooms, prototypes: Prototypes
) -> tuple[Float[Tensor, "used sizes 3"], Float[Tensor, "used sizes"], Float[Tensor, "used sizes"]]:
    """Extents of the entries of each prototype, in pose 0, heights of their bottoms, at least 0,
    both in metres, and their numbers of objects.

    Entries are clusters by complete linkage of the objects' log extents, cut at `SAME_SIZE`;
    objects of far sizes (`FAR_SIZE`) are left out. A prototype without objects has one entry, its
    own extents on the floor. Unused rows have extents of 1 m and the number 0.

    Args:
        rooms: Furnished rooms with looks.
        prototypes: The prototypes of these looks.
    """
    from scipy.cluster.hierarchy import fcluster, linkage  # imported here: training only

    assert rooms.looks is not None
    looks = rooms.looks[rooms.is_object].numpy()
    centers_m, objects_m = rooms.boxes_m[rooms.is_object].double().split(3, dim=-1)
    heights_m = (centers_m - objects_m / 2)[:, 1].clamp(min=0).numpy()
    # Odd poses are turned by a quarter or three, which swaps x and z.
    objects_m = np.where(looks[:, None] % 2 == 1, objects_m.numpy()[:, ::-1], objects_m)
    count = len(prototypes.object_class)
    found_m = torch.ones(count, SIZES, 3)
    bottoms_m, numbers = torch.zeros(2, count, SIZES)
    for row in np.flatnonzero(prototypes.object_class >= 0):
        own = looks // POSES == row
        own_m, own_bottoms_m = objects_m[own], heights_m[own]
        if not len(own_m):
            own_m, own_bottoms_m = prototypes.sizes_m[row, None], np.zeros(1)
        far = abs(np.log(own_m) - np.median(np.log(own_m), axis=0)).max(axis=1)
        near = far <= max(FAR_SIZE, far.min() + 1e-9)
        own_m, own_bottoms_m = own_m[near], own_bottoms_m[near]
        entry = np.zeros(1, dtype=int)
        if len(own_m) > 1:
            joined = linkage(np.log(own_m), "complete", "chebyshev")
            entry = fcluster(joined, SAME_SIZE, "distance") - 1
        number = np.bincount(entry)
        kept = np.argsort(-number, kind="stable")[:SIZES]
        for column, each in enumerate(kept[number[kept] >= min(COMMON, number.max())]):
            found_m[row, column] = torch.from_numpy(np.median(own_m[entry == each], axis=0))
            bottoms_m[row, column] = float(np.median(own_bottoms_m[entry == each]))
            numbers[row, column] = int(number[each])
    return found_m, bottoms_m, numbers

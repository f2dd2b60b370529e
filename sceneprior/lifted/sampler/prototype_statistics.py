"""Statistics of the training rooms that a sampler is given before it is trained: rectangles, pairs
of classes that may intersect, and the backs, fronts, sizes and heights of prototypes.

The back of a prototype is the side nearest to the sides of its rooms' rectangles on average. Masks
do not show the front of a piece of furniture directly. Four cues point to the side opposite to it:
it stands near a wall, nothing stands close behind it, it is higher than the other sides (the back
of a chair, the headboard of a bed), and it is one of the two wide sides.

Real furniture repeats a limited number of models, and lifted boxes of the same model differ by a
few per cent. Objects of one prototype with similar extents are one entry of its list of sizes, with
their median extents, the median height of their bottoms, and their number. An entry holds nothing
about the rooms in which its objects were found.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from sklearn.mixture import GaussianMixture
from torch import Tensor

from sceneprior.core.boxes import QUARTERS
from sceneprior.lifted.prototypes import POSES, PosedRooms, Prototypes
from sceneprior.lifted.sampler.contents import END
from sceneprior.lifted.sampler.frames import (
    gaps_to_sides_m,
    own_sides,
    rectangles_of,
    shared_extents,
)
from sceneprior.lifted.sampler.network import RECTANGLES, SIZES, RoomSampler
from sceneprior.lifted.sampler.rooms import SamplerRooms, frames_of

FURTHEST_M = 1.0
"""Length to which gaps to the sides of the rectangle are clipped before they are averaged."""
WEIGHTS = {"wall": -5.4, "furniture": 2.3, "height": 2.3, "width": 0.94}
"""Weight of each cue in the logit of a side being the back: the mean gap to a wall and the mean gap
to other furniture (metres, up to `FURTHEST_M`), the side's height above the mean of all four
(relative to the object's), and the log of its width over the mean of both. Fitted to the true
fronts of 149 training bedrooms (docs/experiments/2026-11-25-fronts.md), never to a user's rooms."""
BESIDE = 0.3
"""Share of the smaller of two footprints' extents that must overlap, along one axis, for one object
to stand in front of, behind or beside the other."""
STRIP = 0.2
"""Depth of the strip, as a share of a prototype's extent, whose height is that of a side."""
SAME_SIZE = 0.13
"""Largest difference between the log extents of two objects of one entry, along any axis. The value
gives the val rooms' sizes the highest likelihood
(docs/experiments/2026-11-25-sizes-that-repeat.md)."""
COMMON = 2
"""Number of objects that an entry must have, unless no entry of its prototype has as many. An
unusual size is more often an error of lifting than truly rare."""
FRAMES = 8
"""Noisy rectangles per training room to which the mixture is fitted."""
LEAST_VARIANCE = 0.01
"""Added to the variances of the mixture of rectangles: 10 cm squared, or a tenth of an extent
squared."""


def teach(sampler: RoomSampler, rooms: SamplerRooms) -> None:
    """Set the buffers of a fresh sampler from the training rooms: the encodings of looks, the
    mixture of rectangles, the classes that may be sampled, the pairs of classes that may intersect,
    mean footprints, and the sizes, heights, backs and fronts of prototypes."""
    prototypes = rooms.prototypes
    looks = torch.from_numpy(prototypes.shown())
    sampler.look_shown[: len(looks)] = looks
    labels = torch.from_numpy(prototypes.object_class)
    sampler.look_class[: len(looks)] = labels.repeat_interleave(POSES)
    sampler.contents.known[labels[labels >= 0]] = True
    sampler.contents.known[END] = True
    sampler.may_meet.copy_(rooms.may_meet(len(sampler.may_meet)))
    here = rooms.rooms.is_object
    areas_m2 = rooms.rooms.boxes_m[here][:, [3, 5]].prod(dim=-1)
    labels = rooms.rooms.object_class[here]
    sampler.footprints_m2.scatter_reduce_(0, labels, areas_m2, "mean", include_self=False)
    names = ("backs", "fronts", "front_confidence", "sizes_m", "bottoms_m", "size_counts")
    found = (*find_sides(rooms.rooms, prototypes), *find_sizes(rooms.rooms, prototypes))
    for name, values in zip(names, found, strict=True):
        getattr(sampler, name)[: len(values)] = values
    generator = torch.Generator().manual_seed(0)
    furnished = here.any(dim=1)
    frames = torch.cat([frames_of(rooms.rooms, generator) for _ in range(FRAMES)])
    centre, extents = frames[furnished.repeat(FRAMES)].split(2, dim=-1)
    mixture = GaussianMixture(RECTANGLES, reg_covar=LEAST_VARIANCE, random_state=0).fit(
        torch.cat([centre, extents.log()], dim=-1).numpy()
    )
    for buffer, fitted in (
        (sampler.rectangle_logits, np.log(mixture.weights_)),
        (sampler.rectangle_means, mixture.means_),
        (sampler.rectangle_factors, np.linalg.cholesky(mixture.covariances_)),
    ):
        buffer.copy_(torch.from_numpy(fitted))


def mean_by_prototype(
    values: Float[Tensor, "rooms objects 4"], rooms: PosedRooms, prototypes: int
) -> tuple[Float[Tensor, "prototypes 4"], Bool[Tensor, " prototypes"]]:
    """Mean of the objects' values over the objects of each prototype, and whether it occurs."""
    assert rooms.looks is not None
    which = rooms.looks[rooms.is_object] // POSES
    total = torch.zeros(prototypes, QUARTERS).index_add_(0, which, values[rooms.is_object])
    number = torch.bincount(which, minlength=prototypes)
    return total / number.clamp(min=1).unsqueeze(-1), number > 0


def find_sides(
    rooms: PosedRooms, prototypes: Prototypes
) -> tuple[Int[Tensor, " prototypes"], Int[Tensor, " prototypes"], Float[Tensor, " prototypes"]]:
    """The sides of each prototype's back and of its front in pose 0, and the front's confidence.

    The back is the side with the smallest mean gap to the sides of its rooms' rectangles; the front
    is opposite to the side that all cues (`WEIGHTS`) point to.

    Args:
        rooms: Furnished rooms with looks.
        prototypes: The prototypes of these looks.

    Returns:
        Sides 0 to 3 for low z, low x, high z and high x, 0 for the back of a prototype that does
        not occur; probabilities of the fronts, at least 1/4 for prototypes that occur and 0 for
        others, calibrated on the rooms of `WEIGHTS`.
    """
    assert rooms.looks is not None
    sides, used = own_sides(rooms.looks), len(prototypes.parts)
    low, high = gaps_to_sides_m(rooms.boxes_m, rectangles_of(rooms))
    to_walls = torch.stack([low[..., 1], low[..., 0], high[..., 1], high[..., 0]], dim=-1)
    to_walls = to_walls.clamp(max=FURTHEST_M).gather(-1, sides)
    to_others = _gaps_to_furniture(rooms).gather(-1, sides)
    wall, occurs = mean_by_prototype(to_walls, rooms, used)
    furniture, _ = mean_by_prototype(to_others, rooms, used)
    along = np.log(prototypes.sizes_m[:, [0, 2, 0, 2]])
    cues = {
        "wall": wall, "furniture": furniture,
        "height": torch.from_numpy(_heights(prototypes.grids)),
        "width": torch.from_numpy(along - along.mean(axis=1, keepdims=True)),
    }  # fmt: skip
    logits = torch.stack([weight * cues[name].double() for name, weight in WEIGHTS.items()]).sum(0)
    confidence, behind = logits.softmax(dim=1).max(dim=1)
    return wall.argmin(dim=1), (behind + QUARTERS // 2) % QUARTERS, confidence.float() * occurs


def _gaps_to_furniture(rooms: PosedRooms) -> Float[Tensor, "rooms objects 4"]:
    """Gap in metres from each side of each object to the nearest object on that side, at most
    `FURTHEST_M`; sides in the order low z, low x, high z, high x."""
    boxes_m, here = rooms.boxes_m, rooms.is_object
    one, other = boxes_m.unsqueeze(2), boxes_m.unsqueeze(1)
    shared = shared_extents(one, other)
    least = torch.minimum(one[..., 3:], other[..., 3:])
    beside = (shared > BESIDE * least) & (here.unsqueeze(1) & here.unsqueeze(2)).unsqueeze(-1)
    low, high = (boxes_m[..., :3] + sign * boxes_m[..., 3:] / 2 for sign in (-1, 1))
    gaps = []
    for axis, across, upper in ((2, 0, False), (0, 2, False), (2, 0, True), (0, 2, True)):
        mine = (high if upper else low)[..., axis].unsqueeze(2)
        far = (high if upper else low)[..., axis].unsqueeze(1)
        near = (low if upper else high)[..., axis].unsqueeze(1)
        away = (near - mine) if upper else (mine - near)
        reaches = far > mine if upper else far < mine
        there = beside[..., across] & reaches
        gap = away.clamp(min=0).where(there, torch.full_like(away, torch.inf)).amin(dim=2)
        gaps.append(gap.clamp(max=FURTHEST_M))
    return torch.stack(gaps, dim=-1)


def _heights(grids: Bool[np.ndarray, "prototypes x y z"]) -> Float[np.ndarray, "prototypes 4"]:
    """Height of each prototype along each side, relative to the grid's height and minus the mean of
    the four sides."""
    found = np.zeros((len(grids), QUARTERS))
    for row, grid in enumerate(grids):
        if not grid.any():
            continue
        levels = np.arange(1, grid.shape[1] + 1)[None, :, None]
        top = (grid * levels).max(axis=1) / grid.shape[1]
        (x,), (z,) = (np.nonzero(grid.any(axis=axes)) for axes in ((1, 2), (0, 1)))
        top = top[x[0] : x[-1] + 1, z[0] : z[-1] + 1]
        wide, deep = (max(1, round(STRIP * side)) for side in top.shape)
        strips = top[:, :deep], top[:wide].T, top[:, -deep:], top[-wide:].T
        found[row] = [strip.max(axis=1).mean() for strip in strips]
    return found - found.mean(axis=1, keepdims=True)


def find_sizes(
    rooms: PosedRooms, prototypes: Prototypes
) -> tuple[Float[Tensor, "used sizes 3"], Float[Tensor, "used sizes"], Float[Tensor, "used sizes"]]:
    """Extents of the entries of each prototype, in pose 0, heights of their bottoms, at least 0,
    both in metres, and their numbers of objects.

    Entries are clusters by complete linkage of the objects' log extents, cut at `SAME_SIZE`. A
    prototype without objects has one entry, its own extents on the floor. Unused rows have extents
    of 1 m and the number 0.

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

"""Facts about prototypes from the training rooms: the side of the back and of the front, sizes and
heights.

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
from torch import Tensor

from sceneprior.core.boxes import QUARTERS
from sceneprior.lifted.prototypes import POSES, Prototypes
from sceneprior.lifted.rooms import PosedRooms
from sceneprior.lifted.sampler.rooms import (
    gaps_to_sides_m,
    own_sides,
    rectangles_of,
    shared_extents,
)

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
SIZES = 32
"""Maximum number of sizes of a prototype; the most frequent ones are kept."""
SAME_SIZE = 0.13
"""Largest difference between the log extents of two objects of one entry, along any axis. The value
gives the val rooms' sizes the highest likelihood
(docs/experiments/2026-11-25-sizes-that-repeat.md)."""
COMMON = 2
"""Number of objects that an entry must have, unless no entry of its prototype has as many. An
unusual size is more often an error of lifting than truly rare."""


def gaps_by_side(rooms: PosedRooms) -> Float[Tensor, "rooms objects 4"]:
    """Gaps in metres from each object to the four sides of its room's rectangle: low z, low x, high
    z, high x."""
    low, high = gaps_to_sides_m(rooms.boxes_m, rectangles_of(rooms))
    return torch.stack([low[..., 1], low[..., 0], high[..., 1], high[..., 0]], dim=-1)


def mean_by_prototype(
    values: Float[Tensor, "rooms objects 4"], rooms: PosedRooms, prototypes: int
) -> tuple[Float[Tensor, "prototypes 4"], Bool[Tensor, " prototypes"]]:
    """Mean of the objects' values over the objects of each prototype, and whether it occurs."""
    assert rooms.looks is not None
    which = rooms.looks[rooms.is_object] // POSES
    total = torch.zeros(prototypes, QUARTERS).index_add_(0, which, values[rooms.is_object])
    number = torch.bincount(which, minlength=prototypes)
    return total / number.clamp(min=1).unsqueeze(-1), number > 0


def find_backs(rooms: PosedRooms, prototypes: int) -> Int[Tensor, " prototypes"]:
    """The side of each prototype, in pose 0, with the smallest mean gap to the sides of its rooms'
    rectangles; 0 for unused prototypes."""
    assert rooms.looks is not None
    gaps_m = gaps_by_side(rooms).clamp(max=FURTHEST_M).gather(-1, own_sides(rooms.looks))
    return mean_by_prototype(gaps_m, rooms, prototypes)[0].argmin(dim=1)


def find_fronts(
    rooms: PosedRooms, prototypes: Prototypes, count: int
) -> tuple[Int[Tensor, " count"], Float[Tensor, " count"]]:
    """The side to which each prototype's front points in pose 0, with a confidence.

    Args:
        rooms: Furnished rooms with looks.
        prototypes: The prototypes of these looks.
        count: Length of the result, at least the number of prototypes; the rest is 0.

    Returns:
        Sides 0 to 3 for low z, low x, high z and high x; probabilities of these, at least 1/4 for
        prototypes that occur and 0 for others, calibrated on the rooms of `WEIGHTS`.
    """
    assert rooms.looks is not None
    sides = own_sides(rooms.looks)
    to_walls = gaps_by_side(rooms).clamp(max=FURTHEST_M).gather(-1, sides)
    to_others = _gaps_to_furniture(rooms).gather(-1, sides)
    used = len(prototypes.parts)
    wall, occurs = mean_by_prototype(to_walls, rooms, used)
    furniture, _ = mean_by_prototype(to_others, rooms, used)
    along = np.log(prototypes.sizes_m[:, [0, 2, 0, 2]])
    cues = {
        "wall": wall, "furniture": furniture,
        "height": torch.from_numpy(_heights(prototypes.grids)),
        "width": torch.from_numpy(along - along.mean(axis=1, keepdims=True)),
    }  # fmt: skip
    logits = torch.stack([weight * cues[name].double() for name, weight in WEIGHTS.items()]).sum(0)
    confidence, back = logits.softmax(dim=1).max(dim=1)
    fronts, sure = torch.zeros(count, dtype=torch.int64), torch.zeros(count)
    fronts[:used] = (back + QUARTERS // 2) % QUARTERS
    sure[:used] = confidence.float() * occurs
    return fronts, sure


def _gaps_to_furniture(rooms: PosedRooms) -> Float[Tensor, "rooms objects 4"]:
    """Gap in metres from each side of each object to the nearest object on that side, at most
    `FURTHEST_M`; sides in the order of `gaps_by_side`."""
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

"""Estimates which side of each prototype is its front, from masks alone, with a confidence.

Masks do not show the front of a piece of furniture directly. Four cues point to its back: it stands
near a wall, nothing stands close behind it, it is higher than the other sides (the back of a chair,
the headboard of a bed), and it is one of the two wide sides. The front is opposite to the back.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.core.boxes import QUARTERS
from sceneprior.lifted.prototypes import Prototypes
from sceneprior.lifted.rooms import PosedRooms
from sceneprior.lifted.sampler.frames import FURTHEST_M, gaps_by_side, mean_by_prototype, own_sides
from sceneprior.lifted.sampler.rooms import shared_extents

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

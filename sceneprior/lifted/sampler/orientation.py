"""The side of each prototype that is its back, and the pose of each object, found from the rooms.

Masks do not show a front directly, and furniture such as a wardrobe or a nightstand is symmetric:
its masks fit several poses about equally well, and which of them fits best is chance. So poses are
chosen by the rooms. Cues tell how likely each side of an object is its back: a wall is near, other
furniture is near, nothing could open there, a table is on that side or on the opposite one, what
people watch is on that side, the side is higher than the others (a backrest, a headboard), and it
is wide. The back of a prototype and the poses of its objects are those of the highest sum of these
cues and of the likelihood of the rays.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.core.boxes import QUARTERS
from sceneprior.core.wall_lines import Wall
from sceneprior.lifted.prototypes import POSES, PosedRooms, Prototypes
from sceneprior.lifted.sampler.frames import GRAZE_M, OUTWARD, own_sides, shared_extents, side_of

FURTHEST_M = 1.0
"""Length to which gaps are clipped."""
WEIGHTS: dict[str, tuple[float, ...]] = {
    "storage": (-1.69, 0.36, -1.37, 0.07, 0.10, -0.55, 0.05, 2.45),
    "chair": (-1.18, 1.05, -0.05, 1.29, -2.53, -0.12, 1.57, -0.62),
    "sofa": (-1.46, 0.33, -1.17, 0.13, 0.09, -0.66, 1.64, 2.49),
    "bed": (-1.71, 0.30, -1.49, 0.05, 0.12, -0.30, 1.53, -2.67),
}
"""Weights in the logit of a side being the back, by kind of furniture (`kind_of`): the gaps to a
wall, to furniture of any height, to a wall or furniture of the same height, to a table, and from
the opposite side to a table (metres, up to `FURTHEST_M`); 1 if a screen or a bed is on that side;
the side's height above the mean of all four, relative to the object's; and the log of its width
over the mean of both. Fitted to the true fronts of training rooms
(docs/experiments/2026-11-27-fronts-by-the-room.md), never to a user's."""
ROOM_CUES = 6
"""Number of cues of the room; the others are of the prototype."""
PER_RAY_SHARE = 30.0
"""Log-likelihood that an object loses for each unit of its rays explained wrongly: a pose that
explains one ray in ten worse needs cues of 3."""
BESIDE = 0.3
"""Share of the smaller of two footprints' extents that must overlap, along one axis, for one object
to stand in front of, behind or beside the other."""
SECTOR = np.cos(np.pi / 4)
"""Smallest cosine between the direction to an object and that of the side on which it is."""
UNSURE_M = 0.05
"""Standard error of a wall above which it is not used."""
THROUGH_M = 0.3
"""Distance by which an object may reach through a wall behind it."""
FACING = 0.98
"""Minimum cosine between a wall's normal and that of a side it faces: 11 degrees."""
STRIP = 0.2
"""Depth of the strip, as a share of a prototype's extent, whose height is that of a side."""


class Orientation(NamedTuple):
    """Backs of prototypes, and the looks that go with them."""

    backs: Int[Tensor, " prototypes"]
    """Side of each prototype's back in pose 0: 0 to 3 for low z, low x, high z and high x; 0 for a
    prototype that does not occur."""
    confidence: Float[Tensor, " prototypes"]
    """Mean probability that an object's back is on this side; 0 if the prototype does not occur."""
    looks: Int[Tensor, "rooms objects"]
    """Looks with the chosen poses, in place of those of the given rooms."""


def kind_of(label: str) -> str:
    """The kind of furniture of a class, by its name: a key of `WEIGHTS`.

    >>> [kind_of(label) for label in ("kids_bed", "dressing_chair", "armchair", "tv_stand")]
    ['bed', 'chair', 'sofa', 'storage']
    """
    if label.endswith("bed"):
        return "bed"
    if "armchair" in label or "sofa" in label:
        return "sofa"
    return "chair" if "chair" in label or "stool" in label else "storage"


def orient(
    rooms: PosedRooms,
    to_walls_m: Float[Tensor, "rooms objects 4"],
    errors: Float[Tensor, "rooms objects poses"],
    prototypes: Prototypes,
    classes: Sequence[str],
    backs: Int[Tensor, " prototypes"] | None = None,
) -> Orientation:
    """Find the back of each prototype and the pose of each of its objects.

    Args:
        rooms: Rooms with looks, whose poses are ignored.
        to_walls_m: Gap from each side of each object to the walls (`gaps_to_walls`).
        errors: Share of an object's rays that its prototype explains wrongly in each pose.
        backs: The backs, if they are known from other rooms.
    """
    assert rooms.looks is not None
    prototype, count = rooms.looks // POSES, len(prototypes.parts)
    weights = torch.tensor([WEIGHTS[kind_of(label)] for label in classes], dtype=torch.float64)
    cues = (
        room_cues(rooms, to_walls_m, classes).double()
        * weights[rooms.object_class][:, :, None, :ROOM_CUES]
    )
    of_room = cues.sum(dim=-1).log_softmax(dim=-1)
    own = weights[torch.from_numpy(prototypes.object_class).clamp(min=0)][:, None, ROOM_CUES:]
    of_shape = (shape_cues(prototypes) * own).sum(dim=-1)
    # Side of the room of each prototype's side in each pose, and the scores of back and pose.
    turns = own_sides(torch.arange(POSES))
    sides = turns.expand(*rooms.looks.shape, -1, -1)
    scores = of_room[:, :, None].expand_as(sides).gather(-1, sides) - PER_RAY_SHARE * (
        errors - errors.amin(dim=-1, keepdim=True)
    ).unsqueeze(-1)
    here, best = rooms.is_object, scores.amax(dim=2) + of_shape[prototype]
    total = best.new_zeros(count, QUARTERS).index_add_(0, prototype[here], best[here])
    found = total.argmax(dim=1) if backs is None else backs
    chosen = found[prototype][:, :, None, None].expand(-1, -1, POSES, 1)
    pose = scores.gather(-1, chosen)[..., 0].argmax(dim=-1)
    looks = (prototype * POSES + pose).where(here, rooms.looks)
    # A symmetric prototype may have either side as its back: the side of the room is the same.
    to_side = F.one_hot(turns, QUARTERS).double()
    by_side = torch.einsum("ropb,pbs->robs", scores.softmax(dim=2), to_side)
    of_back = total.softmax(dim=1)[prototype]
    sure = torch.einsum("rob,robs->ros", of_back, by_side)
    sure = sure.gather(-1, side_of(looks, found).unsqueeze(-1))[here][:, 0]
    number = torch.bincount(prototype[here], minlength=count).clamp(min=1)
    confidence = sure.new_zeros(count).index_add_(0, prototype[here], sure) / number
    return Orientation(found, confidence.float(), looks)


def room_cues(
    rooms: PosedRooms, to_walls_m: Float[Tensor, "rooms objects 4"], classes: Sequence[str]
) -> Float[Tensor, "rooms objects 4 cues"]:
    """The cues of the room (`WEIGHTS`) for each side of each object, in the order low z, low x,
    high z, high x."""
    boxes_m, here = rooms.boxes_m, rooms.is_object
    to_wall = to_walls_m.clamp(0, FURTHEST_M)
    tables, watched = (
        torch.tensor([each(label) for label in classes])[rooms.object_class].unsqueeze(1)
        for each in (_is_table, _is_watched)
    )
    others = here.unsqueeze(1) & ~torch.eye(here.shape[1], dtype=torch.bool)
    level = shared_extents(boxes_m.unsqueeze(2), boxes_m.unsqueeze(1))[..., 1] > 0
    blocked = torch.minimum(to_wall, _gaps_m(rooms, others & level))
    centre = boxes_m[..., [0, 2]]
    away = centre.unsqueeze(1) - centre.unsqueeze(2)
    ahead = away @ torch.from_numpy(OUTWARD).to(away).T > SECTOR * away.norm(dim=-1, keepdim=True)
    screens = (ahead & (others & watched).unsqueeze(-1)).any(dim=2)
    to_table = _gaps_m(rooms, others & tables)
    return torch.stack(
        [
            to_wall,
            _gaps_m(rooms, others),
            blocked,
            to_table,
            to_table.roll(QUARTERS // 2, dims=-1),
            screens.float(),
        ],
        dim=-1,
    )


def gaps_to_walls(
    boxes_m: Float[np.ndarray, "objects 6"], walls: Sequence[Wall]
) -> Float[np.ndarray, "objects 4"]:
    """Gap in metres from each side of each object of a room to the nearest wall beyond it, or,
    where none is known, to the side of the rectangle around all objects; sides in the order low z,
    low x, high z, high x."""
    centre, half = boxes_m[:, [0, 2]], boxes_m[:, [3, 5]] / 2
    gaps = np.empty((len(boxes_m), QUARTERS))
    for side, outward in enumerate(OUTWARD):
        across = np.flatnonzero(outward == 0)[0]
        own = centre @ outward + half @ abs(outward)
        beyond = [(own.max(initial=-np.inf) - own).clip(min=0)]
        low, high = (centre[:, across] + sign * half[:, across] for sign in (-1, 1))
        for wall in walls:
            if wall.error_m > UNSURE_M or wall.inward @ outward > -FACING:
                continue
            start, end = sorted((wall.start_m[across], wall.end_m[across]))
            gap = (wall.start_m + wall.end_m) @ outward / 2 - own
            there = (start < high - GRAZE_M) & (end > low + GRAZE_M) & (gap > -THROUGH_M)
            beyond.append(np.where(there, gap, np.inf))
        known = np.min(beyond[1:], axis=0) if len(beyond) > 1 else np.full(len(own), np.inf)
        gaps[:, side] = np.where(np.isfinite(known), known, beyond[0])
    return gaps


def _is_table(label: str) -> bool:
    return ("table" in label or "desk" in label) and label != "coffee_table"


def _is_watched(label: str) -> bool:
    return "tv" in label or "television" in label or "bed" in label


def _gaps_m(
    rooms: PosedRooms, others: Bool[Tensor, "rooms objects objects"]
) -> Float[Tensor, "rooms objects 4"]:
    """Gap in metres from each side of each object to the nearest of its `others` on that side, at
    most `FURTHEST_M`; sides in the order low z, low x, high z, high x."""
    boxes_m = rooms.boxes_m
    one, other = boxes_m.unsqueeze(2), boxes_m.unsqueeze(1)
    beside = shared_extents(one, other) > BESIDE * torch.minimum(one[..., 3:], other[..., 3:])
    low, high = (boxes_m[..., :3] + sign * boxes_m[..., 3:] / 2 for sign in (-1, 1))
    gaps = []
    for axis, across, upper in ((2, 0, False), (0, 2, False), (2, 0, True), (0, 2, True)):
        mine = (high if upper else low)[..., axis].unsqueeze(2)
        far = (high if upper else low)[..., axis].unsqueeze(1)
        near = (low if upper else high)[..., axis].unsqueeze(1)
        away = (near - mine) if upper else (mine - near)
        reaches = far > mine if upper else far < mine
        there = others & beside[..., across] & reaches
        gap = away.clamp(min=0).where(there, torch.full_like(away, torch.inf)).amin(dim=2)
        gaps.append(gap.clamp(max=FURTHEST_M))
    return torch.stack(gaps, dim=-1)


def shape_cues(prototypes: Prototypes) -> Float[Tensor, "prototypes 4 2"]:
    """The cues of the prototypes: the height of each side relative to the grid's height, minus the
    mean of the four, and the log of its width over the mean of both."""
    heights = np.zeros((len(prototypes.grids), QUARTERS))
    for row, grid in enumerate(prototypes.grids):
        if not grid.any():
            continue
        levels = np.arange(1, grid.shape[1] + 1)[None, :, None]
        top = (grid * levels).max(axis=1) / grid.shape[1]
        (x,), (z,) = (np.nonzero(grid.any(axis=axes)) for axes in ((1, 2), (0, 1)))
        top = top[x[0] : x[-1] + 1, z[0] : z[-1] + 1]
        wide, deep = (max(1, round(STRIP * side)) for side in top.shape)
        strips = top[:, :deep], top[:wide].T, top[:, -deep:], top[-wide:].T
        heights[row] = [strip.max(axis=1).mean() for strip in strips]
    widths = np.log(prototypes.sizes_m[:, [0, 2, 0, 2]])
    cues = np.stack([heights, widths], axis=-1)
    return torch.from_numpy(cues - cues.mean(axis=1, keepdims=True))

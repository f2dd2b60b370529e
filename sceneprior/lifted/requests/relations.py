"""Relations that can be requested: a closed list, on axis-aligned boxes with a front.

InstructScene (Lin and Mu, ICLR 2024; its `compute_loc_rel`) has left, right, front and behind as
sectors of 90 degrees between centres on the floor, up to 3 m, "closely" below 1 m, and above and
below for an object whose footprint contains the other's centre. InstructScene's sectors follow the
world's axes; here they follow the front of an object, since "in front of the bed" depends on the
direction in which the bed faces.

| relation | condition |
| --- | --- |
| beside | the object overlaps the target along the target's front, and is at most `BESIDE_M` away \
across it |
| in front of | the centre lies in the front sector of the target, at most `FAR_M` from its centre |
| facing | the target's centre lies in the front sector of the object |
| at a wall | the footprint is at most `AT_WALL_M` from a side of the floor |
| in a corner | the footprint is at most `CORNER_M` from a convex corner of the floor |
| under | one centre lies in the other's footprint, and the object's top is below the target's \
bottom or the target is a lamp; under a window: at most `REACH_M` in front of it, and below \
its sill |
| near | the footprints are less than `NEAR_M` apart |
| far from | the centres are more than `FAR_M` apart, beyond which InstructScene has no relation |
"""

from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from sceneprior.core.outline import walls_of
from sceneprior.core.scene import Opening
from sceneprior.lifted.requests.openings import inward_of
from sceneprior.lifted.requests.shape import RoomShape

TO_ROOM = ("at a wall", "in a corner")
"""Relations to the room, which have no target."""
TO_TARGET = ("beside", "in front of", "facing", "under", "near", "far from")
"""Relations to another object, a door or a window."""
RELATIONS = (*TO_TARGET, *TO_ROOM)
OPENINGS = ("door", "window")
"""Targets that are not furniture."""
BESIDE_M = 0.5
NEAR_M = 1.0
"""InstructScene's threshold of "closely", applied to footprints in place of centres: the centres of
a double bed and of a nightstand that touches it are 1.3 m apart."""
FAR_M = 3.0
"""InstructScene's maximum distance between the centres of related objects."""
AT_WALL_M = 0.2
CORNER_M = 0.4
SECTOR_RAD = np.pi / 4
"""Half the angle of a sector."""
REACH_M = 0.5
"""Maximum distance in front of a window at which an object may be `under` the window."""
OUTWARD = np.array([(0.0, -1.0), (-1.0, 0.0), (0.0, 1.0), (1.0, 0.0)])
"""Direction (x, z) towards the sides low z, low x, high z and high x (`side_of`)."""


class Items(NamedTuple):
    """Objects, doors or windows between which relations hold; all arrays have a row per item."""

    boxes_m: Float[np.ndarray, "items 6"]
    """Centre and full extents."""
    front: Float[np.ndarray, "items 2"]
    """Unit vector (x, z) along which the front points."""
    is_lamp: Bool[np.ndarray, " items"]

    def rows(self, rows: Int[np.ndarray, " some"] | Bool[np.ndarray, " items"]) -> "Items":
        """The items of these rows."""
        return Items(*(part[rows] for part in self))


def opening_items(shape: RoomShape, kind: str) -> Items:
    """The doors or windows of a room, as flat boxes whose front points into the room."""
    boxes, fronts = [], []
    for opening in shape.openings:
        if opening.kind == kind:
            boxes.append(_opening_box(opening))
            fronts.append(inward_of(shape, opening))
    return Items(
        np.array(boxes).reshape(-1, 6), np.array(fronts).reshape(-1, 2),
        np.zeros(len(boxes), dtype=bool),
    )  # fmt: skip


def _opening_box(opening: Opening) -> list[float]:
    ends = np.array([opening.start_m, opening.end_m])
    (x, z), (along_x, along_z) = ends.mean(axis=0), np.ptp(ends, axis=0)
    height = opening.top_m - opening.bottom_m
    return [x, (opening.top_m + opening.bottom_m) / 2, z, along_x, height, along_z]


def related(
    relation: str, subjects: Items, targets: Items, to_window: bool = False
) -> Bool[np.ndarray, "subjects targets"]:
    """True where a relation of `TO_TARGET` holds between a subject and a target."""
    here, there = subjects.boxes_m[:, None], targets.boxes_m[None]
    offset = (here - there)[..., [0, 2]]
    gaps = np.abs(offset) - (here + there)[..., [3, 5]] / 2
    distance = np.linalg.norm(offset, axis=-1)
    if relation == "near":
        return np.asarray(np.linalg.norm(gaps.clip(min=0), axis=-1) < NEAR_M)
    if relation == "far from":
        return np.asarray(distance > FAR_M)
    if relation == "facing":
        return _in_sector(-offset, subjects.front[:, None])
    front = np.broadcast_to(targets.front[None], offset.shape)
    if relation == "in front of":
        return _in_sector(offset, front) & (distance <= FAR_M)
    along = np.abs(front) > np.sin(SECTOR_RAD)  # the axis of the target's front
    level = np.where(along, gaps, -np.inf).max(axis=-1) < 0
    across = np.where(along, -np.inf, gaps).max(axis=-1)
    if relation == "beside":
        return np.asarray(level & (across >= -0.05) & (across <= BESIDE_M))
    assert relation == "under", relation
    top = here[..., 1] + here[..., 4] / 2
    below = top <= there[..., 1] - there[..., 4] / 2 + 1e-3
    if to_window:
        before = np.where(along, gaps, -np.inf).max(axis=-1) <= REACH_M
        return np.asarray(before & (across < 0) & below)
    within = (np.abs(offset) <= there[..., [3, 5]] / 2).all(axis=-1)
    within |= (np.abs(offset) <= here[..., [3, 5]] / 2).all(axis=-1)
    return np.asarray(within & (below | targets.is_lamp))


def _in_sector(
    away_m: Float[np.ndarray, "subjects targets 2"], front: Float[np.ndarray, "*batch 2"]
) -> Bool[np.ndarray, "subjects targets"]:
    """True where an offset lies within `SECTOR_RAD` of the front."""
    ahead = (away_m * front).sum(axis=-1)
    return np.asarray(ahead >= np.cos(SECTOR_RAD) * np.linalg.norm(away_m, axis=-1) - 1e-9) & (
        ahead > 0
    )


def related_to_room(
    relation: str, subjects: Items, shape: RoomShape
) -> Bool[np.ndarray, " subjects"]:
    """True for subjects for which a relation of `TO_ROOM` holds."""
    if relation == "at a wall":
        walls, least = shape.polygon.exterior, AT_WALL_M
    else:
        assert relation == "in a corner", relation
        walls, least = shapely.MultiPoint(_convex_corners(shape.outline_m)), CORNER_M
    return np.asarray(shapely.distance(footprints(subjects.boxes_m), walls) <= least)


def footprints(boxes_m: Float[np.ndarray, "boxes 6"]) -> np.ndarray:
    """Rectangles (x, z) of boxes on the floor, as an array of shapely polygons."""
    x, _, z, width, _, depth = boxes_m.T
    return np.asarray(shapely.box(x - width / 2, z - depth / 2, x + width / 2, z + depth / 2))


def _convex_corners(outline_m: Float[np.ndarray, "corners 2"]) -> Float[np.ndarray, "some 2"]:
    """Corners of a floor with an interior angle below 150 degrees."""
    sides = walls_of(outline_m)
    kept = []
    for before, side in zip([sides[-1], *sides], sides, strict=False):
        turning = before.direction @ side.direction < np.cos(np.pi / 6)
        if turning and side.direction @ before.inward > 0:
            kept.append(side.start_m)
    return np.array(kept).reshape(-1, 2)

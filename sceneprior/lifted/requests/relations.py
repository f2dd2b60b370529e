"""Relations that can be requested: a closed list, on axis-aligned boxes with a front, and whether
they hold in furnished and in partly furnished rooms.

InstructScene (Lin and Mu, ICLR 2024; its `compute_loc_rel`) has left, right, front and behind as
sectors of 90 degrees between centres on the floor, up to 3 m, "closely" below 1 m, and above and
below for an object whose footprint contains the other's centre. InstructScene's sectors follow the
world's axes; here they follow the front of an object, since "in front of the bed" depends on the
direction in which the bed faces.

docs/requests.md lists the condition of each relation.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.core.shell import Wall
from sceneprior.lifted.prototypes import PosedRooms
from sceneprior.lifted.requests.floors import Floor, RoomShape
from sceneprior.lifted.requests.wishes import OPENINGS, RelationWish
from sceneprior.lifted.sampler.frames import OUTWARD, side_of
from sceneprior.lifted.sampler.network import RoomSampler

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


class Furniture(NamedTuple):
    """Objects of a room, or its doors or windows, with their classes; all arrays have a row per
    object."""

    boxes_m: Float[np.ndarray, "objects 6"]
    """Centre and full extents."""
    object_class: Int[np.ndarray, " objects"]
    """Index into the label set; -1 for doors and windows."""
    back: Int[np.ndarray, " objects"]
    """Side that is nearest to walls on average: 0 to 3 for low z, low x, high z, high x."""
    front: Float[np.ndarray, "objects 2"]
    """Unit vector (x, z) along which the front points; it need not be opposite to `back`."""

    def rows(self, rows: np.ndarray | slice) -> "Furniture":
        """The objects of these rows."""
        return Furniture(*(part[rows] for part in self))

    def joined(self, others: "Furniture") -> "Furniture":
        """These objects, followed by others."""
        return Furniture(*map(np.concatenate, zip(self, others, strict=True)))


def furniture_of(
    sampler: RoomSampler,
    boxes_m: Float[Tensor, "objects 6"],
    object_class: Int[Tensor, " objects"],
    looks: Int[Tensor, " objects"],
) -> Furniture:
    """Objects, with the sides of their backs and fronts, which follow from their looks."""
    back, front = (side_of(looks, sides).numpy() for sides in (sampler.backs, sampler.fronts))
    return Furniture(boxes_m.double().numpy(), object_class.numpy(), back, OUTWARD[front])


def furniture_in(sampler: RoomSampler, rooms: PosedRooms, row: int) -> Furniture:
    """The objects of a room in a batch."""
    assert rooms.looks is not None
    here = rooms.is_object[row]
    return furniture_of(
        sampler, rooms.boxes_m[row, here], rooms.object_class[row, here], rooms.looks[row, here]
    )


def opening_items(shape: RoomShape, kind: str) -> Furniture:
    """The doors or windows of a room, as flat boxes whose front points into the room."""
    own = [each for each in shape.openings if each.kind == kind]
    boxes = np.zeros((len(own), 6))
    for row, each in enumerate(own):
        ends = np.array([each.start_m, each.end_m])
        boxes[row, [0, 2]], boxes[row, [3, 5]] = ends.mean(axis=0), np.ptp(ends, axis=0)
        boxes[row, 1], boxes[row, 4] = (each.top_m + each.bottom_m) / 2, each.top_m - each.bottom_m
    fronts = np.array([shape.inward(each) for each in own]).reshape(-1, 2)
    return Furniture(boxes, np.full(len(own), -1), np.zeros(len(own), dtype=np.int64), fronts)


def related(
    relation: str, subjects: Furniture, targets: Furniture, label: str
) -> Bool[np.ndarray, "subjects targets"]:
    """True where a relation of `TO_TARGET` holds between a subject and a target.

    Args:
        label: The targets' class, or `door` or `window`. Objects stand under windows and lamps in
            other ways than under others.
    """
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
    if label == "window":
        before = np.where(along, gaps, -np.inf).max(axis=-1) <= REACH_M
        return np.asarray(before & (across < 0) & below)
    within = (np.abs(offset) <= there[..., [3, 5]] / 2).all(axis=-1)
    within |= (np.abs(offset) <= here[..., [3, 5]] / 2).all(axis=-1)
    return np.asarray(within & (below | ("lamp" in label)))


def _in_sector(
    away_m: Float[np.ndarray, "subjects targets 2"], front: Float[np.ndarray, "*batch 2"]
) -> Bool[np.ndarray, "subjects targets"]:
    """True where an offset lies within `SECTOR_RAD` of the front."""
    ahead = (away_m * front).sum(axis=-1)
    return np.asarray(ahead >= np.cos(SECTOR_RAD) * np.linalg.norm(away_m, axis=-1) - 1e-9) & (
        ahead > 0
    )


def related_to_room(
    relation: str, subjects: Furniture, floor: Floor
) -> Bool[np.ndarray, " subjects"]:
    """True for subjects for which a relation of `TO_ROOM` holds."""
    if relation == "at a wall":
        walls, least = floor.polygon.exterior, AT_WALL_M
    else:
        assert relation == "in a corner", relation
        walls, least = shapely.MultiPoint(_convex_corners(floor.walls)), CORNER_M
    return np.asarray(shapely.distance(footprints(subjects.boxes_m), walls) <= least)


def footprints(boxes_m: Float[np.ndarray, "boxes 6"]) -> np.ndarray:
    """Rectangles (x, z) of boxes on the floor, as an array of shapely polygons."""
    x, _, z, width, _, depth = boxes_m.T
    return np.asarray(shapely.box(x - width / 2, z - depth / 2, x + width / 2, z + depth / 2))


def _convex_corners(walls: Sequence[Wall]) -> Float[np.ndarray, "some 2"]:
    """Corners of a floor with an interior angle below 150 degrees."""
    kept = []
    for before, wall in zip([walls[-1], *walls], walls, strict=False):
        turning = before.direction @ wall.direction < np.cos(np.pi / 6)
        if turning and wall.direction @ before.inward > 0:
            kept.append(wall.start_m)
    return np.array(kept).reshape(-1, 2)


class RelationChecks:
    """Checks of the requested relations of one room.

    Args:
        wishes: The requested relations.
        shape: Floor, doors and windows.
        classes: Names of the classes by index.
    """

    def __init__(self, wishes: Sequence[RelationWish], shape: RoomShape, classes: Sequence[str]):
        self.wishes, self.shape, self.classes = wishes, shape, classes
        self.index: dict[str | None, int] = {name: row for row, name in enumerate(classes)}
        self.openings = {kind: opening_items(shape, kind) for kind in OPENINGS}

    def held(self, furniture: Furniture) -> list[bool]:
        """True for each relation that holds in a furnished room."""
        return [int(self._met(wish, furniture).sum()) >= wish.count for wish in self.wishes]

    def can_hold(
        self, label: int, candidates: Furniture, placed: Furniture, upcoming: Sequence[int]
    ) -> Bool[np.ndarray, " candidates"]:
        """True for places of the next object, of class `label`, after which every relation is still
        possible. Upcoming objects are assumed to find places in which their relations hold."""
        possible = np.ones(len(candidates.back), dtype=bool)
        name = self.classes[label]
        for wish in self.wishes:
            if name not in (wish.subject, wish.target):
                continue
            later = [self.classes[index] for index in upcoming]
            if wish.target in later:
                continue
            needed = wish.count - later.count(wish.subject)
            for row in np.flatnonzero(possible):
                joined = placed.joined(candidates.rows(slice(row, row + 1)))
                possible[row] = self._met(wish, joined).sum() >= needed
        return possible

    def _met(self, wish: RelationWish, furniture: Furniture) -> Bool[np.ndarray, " subjects"]:
        """True for each object of the subject's class for which the relation holds."""
        subjects, targets = (
            furniture.rows(furniture.object_class == self.index.get(label, -2))
            for label in (wish.subject, wish.target)
        )
        if wish.target is None:
            return related_to_room(wish.relation, subjects, self.shape.floor)
        targets = self.openings.get(wish.target, targets)
        found = related(wish.relation, subjects, targets, wish.target)
        if wish.subject == wish.target:
            found &= ~np.eye(len(found), dtype=bool)
        return np.asarray(found.any(axis=1))

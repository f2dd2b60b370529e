"""Relations that can be requested: a closed list, on axis-aligned boxes with a front, and whether
they hold in furnished and in partly furnished rooms.

InstructScene (Lin and Mu, ICLR 2024; its `compute_loc_rel`) has left, right, front and behind as
sectors of 90 degrees between centres on the floor, up to 3 m, "closely" below 1 m, and above and
below for an object whose footprint contains the other's centre. InstructScene's sectors follow the
world's axes; here they follow the front of an object, since "in front of the bed" depends on the
direction in which the bed faces.

docs/requests.md lists the condition of each relation.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.core.arrangements import (
    AT_TABLE_M,
    BACK_M,
    BEDS,
    OPENED,
    Piece,
    end_of_bed,
    fronts,
    heads,
    squares_beside,
)  # fmt: skip
from sceneprior.core.scene import quarter_turned
from sceneprior.core.shell import Wall
from sceneprior.lifted.prototypes import PosedRooms
from sceneprior.lifted.requests.floors import Floor, RoomShape
from sceneprior.lifted.requests.wishes import OPENINGS, RelationWish
from sceneprior.lifted.sampler.frames import GRAZE_M, OUTWARD, side_of
from sceneprior.lifted.sampler.network import RoomSampler

BESIDE_M = 0.5
"""Largest distance of what is beside an object, or at its foot; beside a bed, that of
`core/arrangements.py` applies."""
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


STAND_M = 0.4
"""Width of floor that is kept free beside a bed for what stands there later."""


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

    def rows(self, rows: np.ndarray | slice | list[int]) -> "Furniture":
        """The objects of these rows."""
        return Furniture(*(part[rows] for part in self))

    def pieces(self, classes: Sequence[str]) -> list[Piece]:
        """The objects as the checks of function read them.

        Args:
            classes: Names of the classes by index; the names of others are empty.
        """
        found = []
        for box, label, front in zip(
            self.boxes_m.tolist(), self.object_class, self.front, strict=True
        ):
            quarters = round(float(np.arctan2(*front)) / (np.pi / 2)) % 4
            name = classes[label] if 0 <= label < len(classes) else ""
            found.append(Piece.of(name, box[:3], box[3:], quarter_turned(box[3:], quarters)))
        return found

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
    touches = np.linalg.norm(gaps.clip(min=0), axis=-1) <= AT_TABLE_M
    if relation == "against":
        return np.asarray(touches)
    faces = _in_sector(-offset, subjects.front[:, None])
    if relation in ("facing", "at"):
        return faces & (touches | (relation == "facing"))
    front = np.broadcast_to(targets.front[None], offset.shape)
    if relation == "in front of":
        return _in_sector(offset, front) & (distance <= FAR_M)
    if relation == "opposite":
        return faces & _in_sector(offset, front)
    along = np.abs(front) > np.sin(SECTOR_RAD)  # the axis of the target's front
    ahead = np.where(along, gaps, -np.inf).max(axis=-1)
    across = np.where(along, -np.inf, gaps).max(axis=-1)
    if relation == "beside":
        return np.asarray((ahead < 0) & (across >= -0.05) & (across <= BESIDE_M))
    if relation == "at the foot of":
        before = (offset * front).sum(axis=-1) > 0
        return np.asarray(before & (across < 0) & (ahead >= -0.05) & (ahead <= BESIDE_M))
    assert relation == "under", relation
    top = here[..., 1] + here[..., 4] / 2
    below = top <= there[..., 1] - there[..., 4] / 2 + 1e-3
    if label == "window":
        return np.asarray((ahead <= REACH_M) & (across < 0) & below)
    within = (np.abs(offset) <= there[..., [3, 5]] / 2).all(axis=-1)
    within |= (np.abs(offset) <= here[..., [3, 5]] / 2).all(axis=-1)
    return np.asarray(within & (below | ("lamp" in label)))


def _in_sector(
    away_m: Float[np.ndarray, "subjects targets 2"], front: Float[np.ndarray, "*batch 2"]
) -> Bool[np.ndarray, "subjects targets"]:
    """True where an offset lies within `SECTOR_RAD` of the front."""
    ahead = (away_m * front).sum(axis=-1)
    least = np.cos(SECTOR_RAD) * np.linalg.norm(away_m, axis=-1) - 1e-9
    return np.asarray((ahead >= least) & (ahead > 0))


def beside_bed(subjects: Furniture, bed: Piece) -> Float[np.ndarray, "subjects 2"]:
    """The end of a bed, which may be its head, and the side at which each subject stands, as signs
    (`end_of_bed`); zeros for subjects elsewhere."""
    found = np.zeros((len(subjects.back), 2))
    for row, piece in enumerate(subjects.pieces(())):
        place = end_of_bed(bed, piece)
        if place is not None and place[0] in heads(bed):
            found[row] = place
    return found


def on_sides(subjects: Furniture, targets: Furniture, label: str) -> Iterator[np.ndarray]:
    """Places beside a target, for each target and each two sides of it between which subjects can
    be: -1 or 1 for subjects at these sides, 0 for others. A table has two such pairs of sides, and
    a bed one at each end that may be its head."""
    for row in range(len(targets.back)):
        target = targets.rows(slice(row, row + 1))
        if label in BEDS:
            places = beside_bed(subjects, target.pieces((label,))[0])
            for end in (-1, 1):
                yield np.where(places[:, 0] == end, places[:, 1], 0)
            continue
        for turned in (False, True)[: 1 + label.endswith("table")]:
            front = target.front[:, ::-1] if turned else target.front
            own = target._replace(front=front)
            across = np.array([front[0, 1], -front[0, 0]])
            side = np.sign((subjects.boxes_m - own.boxes_m)[:, [0, 2]] @ across)
            yield side * related("beside", subjects, own, label)[:, 0]


def related_to_room(
    relation: str, subjects: Furniture, floor: Floor
) -> Bool[np.ndarray, " subjects"]:
    """True for subjects that stand at a wall, in a corner, or with their back to a wall."""
    if relation == "back to a wall":
        walls = (floor.polygon.exterior,)
        return np.array([each.back_gap_m(walls) <= BACK_M for each in subjects.pieces(())], bool)
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
        blocked: Floor where nothing may stand, such as that where a door swings.
    """

    def __init__(
        self,
        wishes: Sequence[RelationWish],
        shape: RoomShape,
        classes: Sequence[str],
        blocked: Sequence[shapely.Polygon] = (),
    ):
        self.wishes, self.shape, self.classes, self.blocked = wishes, shape, classes, blocked
        self.index: dict[str | None, int] = {name: row for row, name in enumerate(classes)}
        self.openings = {kind: opening_items(shape, kind) for kind in OPENINGS}

    def held(self, furniture: Furniture) -> list[bool]:
        """True for each relation that holds in a furnished room."""
        return [self._number(wish, furniture) >= wish.count for wish in self.wishes]

    def can_hold(self, label: int, furniture: Furniture, upcoming: Sequence[int]) -> bool:
        """True if every relation is still possible in a partly furnished room, whose last object is
        of class `label`. Upcoming objects are assumed to find places in which their relations
        hold."""
        name, later = self.classes[label], [self.classes[index] for index in upcoming]
        for wish in self.wishes:
            at_bed = wish.relation in ("beside", "on both sides of") and wish.target in BEDS
            named = name in (wish.subject, wish.target) or at_bed or wish.needs_free_front
            if not named or wish.target in later:
                continue
            most = later.count(wish.subject)
            if at_bed and most:
                most = min(most, self._free_sides(wish, furniture))
            if self._number(wish, furniture) + most < wish.count:
                return False
        return True

    def _free_sides(self, wish: RelationWish, furniture: Furniture) -> int:
        """The largest number of subjects that still find a place beside a bed."""
        pieces, most = furniture.pieces(self.classes), 0
        for bed in pieces:
            if bed.label != wish.target:
                continue
            taken = [p.place for p in pieces if p is not bed and p.standing] + [*self.blocked]
            free = [
                end
                for (end, _), square in squares_beside(bed, STAND_M).items()
                if self.shape.floor.polygon.covers(square.buffer(-GRAZE_M))
                and not any(square.intersects(place) for place in taken)
            ]
            most = max([most, *(free.count(end) for end in free)])
        return most if wish.count <= 2 else wish.count

    def _number(self, wish: RelationWish, furniture: Furniture) -> int:
        """The number of objects of the subject's class for which the relation holds."""
        subjects, targets = (
            furniture.rows(furniture.object_class == self.index.get(label, -2))
            for label in (wish.subject, wish.target)
        )
        if wish.target is None:
            return int(self._related_to_room(wish, subjects, furniture).sum())
        targets, label = self.openings.get(wish.target, targets), wish.target
        if wish.relation == "on both sides of":
            half = (wish.count + 1) // 2
            numbers = [
                min(half, (side < 0).sum()) + min(half, (side > 0).sum())
                for side in on_sides(subjects, targets, label)
            ]
            return int(max(numbers, default=0))
        if wish.relation == "beside" and label in BEDS:
            beds = targets.pieces(self.classes)
            found = np.array([beside_bed(subjects, bed)[:, 0] != 0 for bed in beds], dtype=bool).T
            found = found.reshape(len(subjects.back), len(beds))
        else:
            found = related(wish.relation, subjects, targets, label)
        if wish.subject == wish.target:
            found &= ~np.eye(len(found), dtype=bool)
        return int(found.any(axis=1).sum())

    def _related_to_room(
        self, wish: RelationWish, subjects: Furniture, furniture: Furniture
    ) -> Bool[np.ndarray, " subjects"]:
        """True for subjects for which a relation of `TO_ROOM` holds. Classes that are used from
        their front are at a wall if their back is at it and the floor before them is free."""
        floor, found = self.shape.floor, np.ones(len(subjects.back), dtype=bool)
        if wish.relation != "with a free front":
            found = related_to_room(wish.relation, subjects, floor)
            if wish.subject in OPENED and wish.relation == "at a wall":
                found = related_to_room("back to a wall", subjects, floor)
        if not wish.needs_free_front:
            return found
        pieces = furniture.pieces(self.classes)
        rows = np.flatnonzero(furniture.object_class == self.index[wish.subject])
        usable = [True] * len(pieces)
        for outcomes in fronts(pieces, floor.polygon).values():
            for each in outcomes:
                usable[each.rows[0]] &= each.holds
        return found & np.array(usable, dtype=bool)[rows]

"""Placement rules of a requested room: walls behind backs, ceiling, doors and windows, relations,
and paths from the doors. Candidate places of an object are checked against all of them."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from sceneprior.core.arrangements import NIGHTSTANDS
from sceneprior.core.shell import space_before
from sceneprior.lifted.requests.faults import COMFORT, PATH_M, Fault, faults_of, places_to_reach
from sceneprior.lifted.requests.floors import RoomShape
from sceneprior.lifted.requests.relations import Furniture, RelationChecks, footprints
from sceneprior.lifted.requests.wishes import RelationWish
from sceneprior.lifted.sampler.frames import OUTWARD

FLUSH_M = 0.15
"""Maximum gap between an object's back and a side of its rectangle in the floor at which the object
counts as standing with its back to this side."""
WALL_M = 0.3
"""Maximum distance of the middle of such a back from a wall."""
CELL_M = 0.05
"""Edge length of the cells of the grid on which paths are found."""
HEAD_M = 1.8
"""Objects whose bottom is higher than this are no obstacles."""
FLAT_M = 0.05
"""Objects up to this height, such as rugs, are no obstacles."""
ARM_M = 0.1
"""Largest gap between a path and an object that it reaches."""
FLOOR_M = 0.3
"""Largest height of the bottom of objects that must be reached, which are those on the floor."""
BEFORE_WINDOW_M = 0.4
"""Depth of the floor in front of a window where objects must not be higher than the sill."""
BEFORE_WINDOWS = ("lamp", "plant")
"""Words in the names of classes that may stand or hang in front of a window."""


class Zone(NamedTuple):
    """Space in front of an opening that must stay free: a polygon (x, z) and a range of heights."""

    polygon: shapely.Polygon
    from_m: float
    to_m: float


def zones_of(shape: RoomShape) -> dict[str, list[Zone]]:
    """The spaces that must stay free, by kind of opening: in front of a door, the volume through
    which it swings, as deep as the door is wide; in front of a window, the space above the sill."""
    zones: dict[str, list[Zone]] = {"door": [], "window": []}
    for each in shape.openings:
        is_door = each.kind == "door"
        depth_m = math.dist(each.start_m, each.end_m) if is_door else BEFORE_WINDOW_M
        # 1 cm smaller on all sides, so that furniture may touch the zone.
        polygon = space_before(each, shape.inward(each), depth_m).buffer(-0.01)
        zones[each.kind].append(Zone(polygon, 0.0 if is_door else each.bottom_m, each.top_m))
    return zones


class PlacementRules:
    """The rules for places in one requested room.

    Args:
        shape: Floor, doors, windows and ceiling.
        wishes: Requested relations.
        classes: Names of the classes by index.
        given: Objects that stay where they are, even if no path leads to them.
        comfort: Faults of comfort count, too.
    """

    def __init__(
        self,
        shape: RoomShape,
        wishes: Sequence[RelationWish],
        classes: Sequence[str],
        given: Furniture,
        comfort: bool,
    ):
        self.shape, self.classes, self.comfort = shape, classes, comfort
        self._zones = zones_of(shape)
        swings = [zone.polygon for zone in self._zones["door"]]
        self.relations = RelationChecks(wishes, shape, classes, swings)
        self._needs_access = needs_access(classes)
        has_door = any(each.kind == "door" for each in shape.openings)
        self._paths = Paths(shape) if has_door else None
        self._given_unreached = ~self._reached(given)

    def allowed(
        self,
        label: int,
        candidates: Furniture,
        placed: Furniture,
        upcoming: Sequence[int],
        rectangles_m: Float[np.ndarray, "candidates 4"],
        enough: int,
    ) -> tuple[Bool[np.ndarray, " candidates"], str]:
        """True for places that an object of class `label` may take, and a reason for rejections.

        Args:
            candidates: Places of the object.
            placed: Objects in the room, the given ones first.
            upcoming: Classes of objects that are placed later.
            rectangles_m: Rectangle in the floor from which each place was drawn.
            enough: Largest number of places to allow, since finding paths is slow.
        """
        allowed = np.ones(len(candidates.back), dtype=bool)
        reason = ""
        tops_m = candidates.boxes_m[:, 1] + candidates.boxes_m[:, 4] / 2
        for name, passed in {
            "a wall behind it": backed_by_walls(self.shape, candidates, rectangles_m),
            "room below the ceiling": tops_m <= (self.shape.ceiling_m or math.inf) + 1e-4,
            "distance from a door": self._leaves_free("door", label, candidates),
            "distance from a window": self._leaves_free("window", label, candidates),
        }.items():
            reason = reason or name * bool((allowed & ~passed).any())
            allowed &= passed
        for row in np.flatnonzero(allowed):
            allowed[row] = False
            if enough <= 0:
                continue
            joined = placed.joined(candidates.rows(slice(row, row + 1)))
            if not self.relations.can_hold(label, joined, upcoming):
                reason = reason or "a place that its relations allow"
            elif not self._all_reached(joined):
                reason = reason or "a path from a door"
            else:
                allowed[row], enough = True, enough - 1
        return allowed, reason

    def faults(self, furniture: Furniture) -> set[Fault]:
        """Faults of a partly furnished room (`faults.py`), and places to which no path leads. Those
        that later objects may mend are left out."""
        pieces = furniture.pieces(self.classes)
        failed = {
            fault
            for fault in faults_of(pieces, self.shape.floor.polygon)
            if self.comfort or fault[0] not in COMFORT
        }
        if self._paths is not None and (used_from := places_to_reach(pieces)):
            walked = self._paths.walked(furniture.boxes_m)
            failed |= {
                key for key, strip in used_from.items() if not self._paths.meet(strip, walked)
            }
        return failed

    def _all_reached(self, furniture: Furniture) -> bool:
        """True if a path leads to every object, but for given ones that had none from the start."""
        reached = self._reached(furniture)
        reached[: len(self._given_unreached)] |= self._given_unreached
        return bool(reached.all())

    def _reached(self, furniture: Furniture) -> Bool[np.ndarray, " objects"]:
        if self._paths is None:
            return np.ones(len(furniture.back), dtype=bool)
        return self._paths.reached(furniture.boxes_m, self._needs_access[furniture.object_class])

    def _leaves_free(
        self, kind: str, label: int, candidates: Furniture
    ) -> Bool[np.ndarray, " candidates"]:
        """True for places that do not block the space in front of doors or windows."""
        free = np.ones(len(candidates.back), dtype=bool)
        may = any(word in self.classes[label] for word in BEFORE_WINDOWS)
        if not self._zones[kind] or (kind == "window" and may):
            return free
        floors = footprints(candidates.boxes_m)
        low_m = candidates.boxes_m[:, 1] - candidates.boxes_m[:, 4] / 2
        high_m = candidates.boxes_m[:, 1] + candidates.boxes_m[:, 4] / 2
        for zone in self._zones[kind]:
            level = (high_m > zone.from_m + 0.01) & (low_m < zone.to_m)
            free &= ~(level & shapely.intersects(floors, zone.polygon))
        return free


def backed_by_walls(
    shape: RoomShape, candidates: Furniture, rectangles_m: Float[np.ndarray, "candidates 4"]
) -> Bool[np.ndarray, " candidates"]:
    """False for places whose back is at a side of their rectangle but not at a wall: in an L-shaped
    floor, some sides of rectangles are not walls."""
    if shape.floor.is_rectangle:
        return np.ones(len(candidates.back), dtype=bool)
    inward = -OUTWARD[candidates.back]
    middles_m = candidates.boxes_m[:, [0, 2]] - inward * candidates.boxes_m[:, [3, 5]] / 2
    sides_m = rectangles_m[:, :2] - inward * rectangles_m[:, 2:] / 2
    gaps_m = np.abs(((middles_m - sides_m) * inward).sum(axis=1))
    at_wall = shapely.distance(shapely.points(middles_m), shape.floor.polygon.exterior) <= WALL_M
    return np.asarray((gaps_m > FLUSH_M) | at_wall)


class Paths:
    """Grid of the points where the middle of a path of width `PATH_M` may lie.

    Args:
        shape: A room. In a room without doors, every object counts as reached.
    """

    def __init__(self, shape: RoomShape):
        low_x, low_z, high_x, high_z = shape.floor.polygon.bounds
        self.low_m = np.array([low_x, low_z])
        x, z = (np.arange(a + CELL_M / 2, b, CELL_M) for a, b in ((low_x, high_x), (low_z, high_z)))
        # A little less than half of the path, since cells are sampled at their centres.
        inner = shape.floor.polygon.buffer(-PATH_M / 2 + CELL_M / 2 - 1e-6, join_style="mitre")
        shapely.prepare(inner)
        self.floor: Bool[np.ndarray, "x z"] = shapely.contains_xy(inner, x[:, None], z[None])
        self.starts: list[Int[np.ndarray, 2]] = []
        for each in shape.openings:
            if each.kind == "door":
                middle = np.mean([each.start_m, each.end_m], axis=0)
                inside = middle + (PATH_M / 2 + CELL_M / 2) * shape.inward(each)
                self.starts.append(((inside - self.low_m) / CELL_M).astype(int))

    def reached(
        self, boxes_m: Float[np.ndarray, "objects 6"], needs_access: Bool[np.ndarray, " objects"]
    ) -> Bool[np.ndarray, " objects"]:
        """True for objects to which paths lead from all doors, with all boxes as obstacles, and for
        objects that need no path.

        Args:
            needs_access: True for objects that must be reached if they stand on the floor.
        """
        bottoms = boxes_m[:, 1] - boxes_m[:, 4] / 2
        needed = needs_access & (bottoms <= FLOOR_M) & (boxes_m[:, 4] > FLAT_M)
        found = np.ones(len(boxes_m), dtype=bool)
        if self.starts and needed.any():
            walked = self.walked(boxes_m)
            for row in np.flatnonzero(needed):
                around = self._cells(boxes_m[row], PATH_M / 2 + ARM_M)
                found[row] = walked[:, *around].any(axis=(1, 2)).all()
        return found

    def walked(self, boxes_m: Float[np.ndarray, "objects 6"]) -> Bool[np.ndarray, "doors x z"]:
        """The points to which paths lead from each door, with all boxes as obstacles."""
        from scipy import ndimage

        free = self.floor.copy()
        bottoms = boxes_m[:, 1] - boxes_m[:, 4] / 2
        for row in np.flatnonzero((bottoms < HEAD_M) & (boxes_m[:, 4] > FLAT_M)):
            free[self._cells(boxes_m[row], PATH_M / 2 - CELL_M / 2)] = False
        areas, _ = ndimage.label(free)
        found = []
        for x, z in self.starts:
            area = areas[max(x - 2, 0) : x + 3, max(z - 2, 0) : z + 3]
            found.append(np.isin(areas, np.unique(area[area > 0])))
        return np.array(found)

    def meet(self, strip: shapely.Polygon, walked: Bool[np.ndarray, "doors x z"]) -> bool:
        """True if paths lead from every door to a strip of floor along the axes."""
        low_x, low_z, high_x, high_z = strip.bounds
        x, z = (low_x + high_x) / 2, (low_z + high_z) / 2
        cells = self._cells(np.array([x, 0.0, z, high_x - low_x, 0.0, high_z - low_z]), 0.0)
        return bool(walked[:, *cells].any(axis=(1, 2)).all())

    def _cells(self, box_m: Float[np.ndarray, "6"], margin_m: float) -> tuple[slice, slice]:
        """The cells of a footprint, with a margin around it."""
        half = box_m[[3, 5]] / 2 + margin_m
        low = np.round((box_m[[0, 2]] - half - self.low_m) / CELL_M).astype(int).clip(min=0)
        high = np.round((box_m[[0, 2]] + half - self.low_m) / CELL_M).astype(int).clip(min=0)
        return slice(low[0], high[0]), slice(low[1], high[1])


def needs_access(labels: Sequence[str]) -> Bool[np.ndarray, " labels"]:
    """True for classes that must be reachable: all but lamps, plants, and nightstands, which are
    reached from the bed."""
    words = ("lamp", "plant", *NIGHTSTANDS)
    return np.array([not any(word in label for word in words) for label in labels])

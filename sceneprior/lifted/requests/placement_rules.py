"""Placement rules of a requested room: walls behind backs, ceiling, doors and windows, relations,
and paths from the doors. Candidate places of an object are checked against all of them."""

from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Bool, Float

from sceneprior.lifted.requests.openings import zones_of
from sceneprior.lifted.requests.paths import Paths, needs_access
from sceneprior.lifted.requests.relation_checks import Furniture, RelationChecks
from sceneprior.lifted.requests.relations import OUTWARD, footprints
from sceneprior.lifted.requests.shape import RoomShape
from sceneprior.lifted.requests.wishes import RelationWish

FLUSH_M = 0.15
"""Maximum gap between an object's back and a side of its rectangle in the floor at which the object
counts as standing with its back to this side."""
WALL_M = 0.3
"""Maximum distance of the middle of such a back from a wall."""
BEFORE_WINDOWS = ("lamp", "plant")
"""Words in the names of classes that may stand or hang in front of a window."""


class PlacementRules:
    """The rules for places in one requested room.

    Args:
        shape: Floor, doors, windows and ceiling.
        wishes: Requested relations.
        classes: Names of the classes by index.
        given: Objects that stay where they are, even if no path leads to them.
    """

    def __init__(
        self,
        shape: RoomShape,
        wishes: Sequence[RelationWish],
        classes: Sequence[str],
        given: Furniture,
    ):
        self.shape, self.classes = shape, classes
        self.relations = RelationChecks(wishes, shape, classes)
        self._zones = zones_of(shape)
        self._needs_access = needs_access(classes)
        has_door = any(each.kind == "door" for each in shape.openings)
        self._paths = Paths(shape) if has_door else None
        self._unreached_given = ~self._reached(given)

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
        for name, passed in {
            "a wall behind it": backed_by_walls(self.shape, candidates, rectangles_m),
            "room below the ceiling": self._below_ceiling(candidates),
            "distance from a door": self._leaves_free("door", label, candidates),
            "distance from a window": self._leaves_free("window", label, candidates),
        }.items():
            reason = reason or name * bool((allowed & ~passed).any())
            allowed &= passed
        rows = np.flatnonzero(allowed)
        allowed[rows] = self.relations.can_hold(label, candidates.rows(rows), placed, upcoming)
        if not allowed[rows].all():
            reason = reason or "a place that its relations allow"
        if self._paths is None:
            return allowed, reason
        for row in np.flatnonzero(allowed):
            joined = placed.joined(candidates.rows(slice(row, row + 1)))
            allowed[row] = enough > 0 and self._reached(joined)[len(self._unreached_given) :].all()
            if enough > 0 and not allowed[row]:
                reason = reason or "a path from a door"
            enough -= int(allowed[row])
        return allowed, reason

    def _reached(self, furniture: Furniture) -> Bool[np.ndarray, " objects"]:
        if self._paths is None:
            return np.ones(len(furniture.back), dtype=bool)
        return self._paths.reached(furniture.boxes_m, self._needs_access[furniture.object_class])

    def _below_ceiling(self, candidates: Furniture) -> Bool[np.ndarray, " candidates"]:
        if self.shape.ceiling_m is None:
            return np.ones(len(candidates.back), dtype=bool)
        tops_m = candidates.boxes_m[:, 1] + candidates.boxes_m[:, 4] / 2
        return np.asarray(tops_m <= self.shape.ceiling_m + 0.01)

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
    if shape.is_rectangle:
        return np.ones(len(candidates.back), dtype=bool)
    inward = -OUTWARD[candidates.back]
    middles_m = candidates.boxes_m[:, [0, 2]] - inward * candidates.boxes_m[:, [3, 5]] / 2
    sides_m = rectangles_m[:, :2] - inward * rectangles_m[:, 2:] / 2
    gaps_m = np.abs(((middles_m - sides_m) * inward).sum(axis=1))
    at_wall = shapely.distance(shapely.points(middles_m), shape.polygon.exterior) <= WALL_M
    return np.asarray((gaps_m > FLUSH_M) | at_wall)

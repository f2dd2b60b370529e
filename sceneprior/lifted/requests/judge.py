"""Places that a requested room allows: what stands where, checked for each candidate place."""

from collections.abc import Callable, Sequence

import numpy as np
import shapely
from jaxtyping import Bool, Float

from sceneprior.lifted.requests.holding import Furniture, Relations
from sceneprior.lifted.requests.openings import zones_of
from sceneprior.lifted.requests.relations import OUTWARD
from sceneprior.lifted.requests.shape import RoomShape
from sceneprior.lifted.requests.ways import Ways, is_functional
from sceneprior.lifted.requests.wishes import RelationWish

FLUSH_M = 0.15
"""Gap up to which a back counts as standing at a side of a rectangle in the floor."""
WALL_M = 0.3
"""Largest distance of such a back's middle from a real wall."""
BEFORE_WINDOWS = ("lamp", "plant")
"""Words in the names of classes that may stand or hang before a window."""

Check = Callable[[], Bool[np.ndarray, " candidates"]]


class Judge:
    """The places that one requested room allows.

    Args:
        shape: Floor, doors, windows and ceiling.
        wishes: Wished relations.
        classes: Names of the classes by index.
        given: Objects that stay where they are, even where no way leads to them.
    """

    def __init__(
        self,
        shape: RoomShape,
        wishes: Sequence[RelationWish],
        classes: Sequence[str],
        given: Furniture,
    ):
        self.shape, self.classes = shape, classes
        self.relations = Relations(wishes, shape, classes)
        self._zones = zones_of(shape)
        self._functional = is_functional(classes)
        has_door = any(each.kind == "door" for each in shape.openings)
        self._ways = Ways(shape) if has_door else None
        self._cut_off = ~self._reached(given)

    def allows(
        self,
        label: int,
        candidates: Furniture,
        standing: Furniture,
        coming: Sequence[int],
        rectangles_m: Float[np.ndarray, "candidates 4"],
        enough: int,
    ) -> tuple[Bool[np.ndarray, " candidates"], str]:
        """Which places an object of a class may take, and what the first others lack.

        Args:
            candidates: Places of the object.
            standing: Objects that are there, the given ones first.
            coming: Classes that come later.
            rectangles_m: Rectangles in the floor that the places were drawn in.
            enough: Places to allow at most: ways are slow to find.
        """
        allowed = np.ones(len(candidates.back), dtype=bool)
        hurdle = ""
        checks: list[tuple[str, Check]] = [
            ("a wall behind it", lambda: backed_by_walls(self.shape, candidates, rectangles_m)),
            ("room below the ceiling", lambda: self._below_ceiling(candidates)),
            ("distance from a door", lambda: self._leaves_free("door", label, candidates)),
            ("distance from a window", lambda: self._leaves_free("window", label, candidates)),
        ]
        for name, check in checks:
            allowed, hurdle = _narrowed(allowed, check(), hurdle, name)
        rows = np.flatnonzero(allowed)
        some = Furniture(*(part[rows] for part in candidates))
        possible = allowed.copy()
        possible[rows] = self.relations.can_hold(label, some, standing, coming)
        allowed, hurdle = _narrowed(allowed, possible, hurdle, "a place that its relations allow")
        if self._ways is None:
            return allowed, hurdle
        for row in np.flatnonzero(allowed):
            own = Furniture(*(part[row : row + 1] for part in candidates))
            joined = Furniture(*map(np.concatenate, zip(standing, own, strict=True)))
            allowed[row] = enough > 0 and self._reached(joined)[len(self._cut_off) :].all()
            if enough > 0 and not allowed[row]:
                hurdle = hurdle or "a way from a door"
            enough -= int(allowed[row])
        return allowed, hurdle

    def _reached(self, furniture: Furniture) -> Bool[np.ndarray, " objects"]:
        if self._ways is None:
            return np.ones(len(furniture.back), dtype=bool)
        return self._ways.reached(furniture.boxes_m, self._functional[furniture.object_class])

    def _below_ceiling(self, candidates: Furniture) -> Bool[np.ndarray, " candidates"]:
        if self.shape.ceiling_m is None:
            return np.ones(len(candidates.back), dtype=bool)
        tops_m = candidates.boxes_m[:, 1] + candidates.boxes_m[:, 4] / 2
        return np.asarray(tops_m <= self.shape.ceiling_m + 0.01)

    def _leaves_free(
        self, kind: str, label: int, candidates: Furniture
    ) -> Bool[np.ndarray, " candidates"]:
        """True for places that leave the space before doors or windows free."""
        free = np.ones(len(candidates.back), dtype=bool)
        may = any(word in self.classes[label] for word in BEFORE_WINDOWS)
        if not self._zones[kind] or (kind == "window" and may):
            return free
        x, y, z, width, height, depth = candidates.boxes_m.T
        footprints = shapely.box(x - width / 2, z - depth / 2, x + width / 2, z + depth / 2)
        for zone in self._zones[kind]:
            level = (y + height / 2 > zone.from_m + 0.01) & (y - height / 2 < zone.to_m)
            free &= ~(level & shapely.intersects(footprints, zone.polygon))
        return free


def _narrowed(
    allowed: Bool[np.ndarray, " candidates"],
    passed: Bool[np.ndarray, " candidates"],
    hurdle: str,
    name: str,
) -> tuple[Bool[np.ndarray, " candidates"], str]:
    """The allowed places that pass a check, and the first hurdle of all."""
    failed = bool((allowed & ~passed).any())
    return allowed & passed, hurdle or (name if failed else "")


def backed_by_walls(
    shape: RoomShape, candidates: Furniture, rectangles_m: Float[np.ndarray, "candidates 4"]
) -> Bool[np.ndarray, " candidates"]:
    """True for places whose back is at a wall, or not at a side of their rectangle in the floor."""
    if shape.is_rectangle:
        return np.ones(len(candidates.back), dtype=bool)
    inward = -OUTWARD[candidates.back]
    middles_m = candidates.boxes_m[:, [0, 2]] - inward * candidates.boxes_m[:, [3, 5]] / 2
    sides_m = rectangles_m[:, :2] - inward * rectangles_m[:, 2:] / 2
    gaps_m = np.abs(((middles_m - sides_m) * inward).sum(axis=1))
    at_wall = shapely.distance(shapely.points(middles_m), shape.polygon.exterior) <= WALL_M
    return np.asarray((gaps_m > FLUSH_M) | at_wall)

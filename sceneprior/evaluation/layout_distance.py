"""How far one room's layout is from another's, and from the nearest training room's."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sceneprior.geometry.turns import QUARTERS, quarter_rotation
from sceneprior.scene import Scene

MISSING_M = 1.0
"""What an object without a counterpart counts; a pair farther apart than this counts no more."""
_CLASS_STEP = 1e6  # farther apart than any two boxes: other classes cost MISSING_M
_MIRROR = np.diag([-1.0, 1.0, 1.0])
TURNS = tuple(
    quarter_rotation(quarters).T @ mirror
    for quarters in range(QUARTERS)
    for mirror in (np.eye(3), _MIRROR)
)
"""Four quarter turns, of the room and of its mirror image, which training may have turned to."""


def layout_distance(a: Scene, b: Scene) -> float:
    """How far furniture of one room must be moved and resized to make the other, in metres.

    Objects are paired one to one within classes, at the least total cost; a pair costs the length
    of (difference of centres, difference of sizes), at most 1 m, an object without a partner 1 m.
    The sum is divided by the number of objects in the larger room: 0 for equal layouts, 1 for two
    that share nothing. Two empty rooms are at distance 0.

    Example: one of two chairs moved by 30 cm.

        >>> from sceneprior.scene import SceneObject
        >>> def room(x):
        ...     chairs = [((0.0, 0.5, 0.0)), ((x, 0.5, 2.0))]
        ...     chairs = tuple(SceneObject("chair", at, (0.5, 1.0, 0.5)) for at in chairs)
        ...     return Scene("a", "front3d_bedroom", chairs)
        >>> round(layout_distance(room(1.0), room(1.3)), 9)
        0.15
    """
    return _distance(_costs(_rows(a), _rows(b)))


def _costs(placed: np.ndarray, others: np.ndarray) -> np.ndarray:
    # SciPy is imported where something is compared: most commands import this file and do not.
    from scipy.spatial.distance import cdist

    return np.asarray(np.minimum(cdist(placed, others), MISSING_M))


def _distance(costs: np.ndarray) -> float:
    from scipy.optimize import linear_sum_assignment

    larger = max(costs.shape)
    if larger == 0:
        return 0.0
    matched = float(costs[linear_sum_assignment(costs)].sum()) if min(costs.shape) else 0.0
    return (matched + MISSING_M * (larger - min(costs.shape))) / larger


def _rows(scene: Scene) -> np.ndarray:
    """(objects, 7): centre, size, and the class so far apart that other classes never pair."""
    label = _CLASS_STEP * scene.class_indices[:, None]
    return np.hstack([scene.centers_m, scene.sizes_m, label])


def nearest_distances(
    scenes: Sequence[Scene],
    training: Sequence[Scene],
    pass_over_own: bool = False,
    same_classes: bool = False,
) -> Float[np.ndarray, " scenes"]:
    """The layout distance of each scene to the nearest training room, over all of `TURNS`.

    Exact and quick: most training rooms are ruled out by what each object would cost if it could
    choose freely.

    Args:
        training: Training rooms, true or decoded.
        pass_over_own: Where the scenes are training rooms: each passes over that of its own name.
        same_classes: Compare only with rooms of as many objects of each class.

    Returns:
        Metres; inf where there is no room to compare with.
    """
    rooms = _Rooms(training)
    names = np.array([room.name for room in training])
    contents = [sorted(room.class_indices.tolist()) for room in training]
    nearest = np.full(len(scenes), np.inf)
    for row, scene in enumerate(scenes):
        allowed = np.ones(len(training), dtype=bool)
        if pass_over_own:
            allowed &= names != scene.name
        if same_classes:
            mine = sorted(scene.class_indices.tolist())
            allowed &= np.array([theirs == mine for theirs in contents], dtype=bool)
        if allowed.any():
            nearest[row] = rooms.nearest(scene, allowed)[1]
    return nearest


def nearest_room(scene: Scene, training: Sequence[Scene]) -> tuple[int, float]:
    """Which of at least one training room is nearest to a scene, and its distance in metres; as
    `nearest_distances`."""
    return _Rooms(training).nearest(scene, np.ones(len(training), dtype=bool))


class _Rooms:
    """Rooms to search."""

    def __init__(self, rooms: Sequence[Scene]):
        each = [_rows(room) for room in rooms]
        self.counts = np.array([len(room) for room in each], dtype=np.int64)
        self.objects = np.concatenate([np.zeros((0, 7)), *each])
        self.starts = np.cumsum(self.counts) - self.counts

    def nearest(self, scene: Scene, allowed: Bool[np.ndarray, " rooms"]) -> tuple[int, float]:
        """The nearest of the allowed rooms (at least one), and its distance."""
        best, found, placed = np.inf, 0, _rows(scene)
        for turn in TURNS:
            costs = _costs(_turned(placed, turn), self.objects)
            bounds = _lower_bounds(costs, self.starts, self.counts)
            bounds = np.where(allowed, bounds, np.inf)
            for room in np.argsort(bounds):
                if bounds[room] >= best:
                    break
                start = self.starts[room]
                distance = _distance(costs[:, start : start + self.counts[room]])
                if distance < best:
                    best, found = distance, int(room)
        return found, float(best)


def _turned(rows: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return np.hstack([rows[:, :3] @ turn, rows[:, 3:6] @ np.abs(turn), rows[:, 6:]])


def _lower_bounds(costs: np.ndarray, starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """What each training room costs at least: every object takes its cheapest partner freely."""
    mine = len(costs)
    # One more column, so that an empty room at the end has a place to start at; it belongs to the
    # last room, so it must neither add to a sum nor be the least.
    cheapest = np.append(costs.min(0, initial=MISSING_M), 0.0)
    theirs = np.add.reduceat(cheapest, starts) * (counts > 0)
    ours = np.minimum.reduceat(np.hstack([costs, np.full((mine, 1), MISSING_M)]), starts, axis=1)
    ours = np.where(counts > 0, ours, MISSING_M).sum(0)
    least = np.maximum(
        theirs + MISSING_M * np.maximum(mine - counts, 0),
        ours + MISSING_M * np.maximum(counts - mine, 0),
    )
    # A hair lower: sums in another order must not rule out an equally near room.
    return np.asarray(least / np.maximum(np.maximum(counts, mine), 1) - 1e-12)


class Nearest(NamedTuple):
    """How far rooms are from what a prior has seen or remembers, in metres."""

    training_m: Float[np.ndarray, " rooms"]
    """To the nearest true training room."""
    decoded_m: Float[np.ndarray, " rooms"] | None
    """To the nearest training room as the prior decodes it; None where it decodes none."""
    same_classes_m: Float[np.ndarray, " rooms"]
    """To the nearest of both that holds the same classes, each as often; inf where none does."""

    def of(self, rows: Sequence[int]) -> "Nearest":
        """Those of some of the rooms."""
        picked = [None if part is None else part[list(rows)] for part in self]
        return Nearest(*picked)  # type: ignore[arg-type]


def nearest_known(
    scenes: Sequence[Scene],
    training: Sequence[Scene],
    decoded: Sequence[Scene],
    pass_over_own: bool = False,
) -> Nearest:
    """Distances of each scene to all training rooms and, if any, to all decoded ones."""

    def to(rooms: Sequence[Scene], same_classes: bool = False) -> np.ndarray:
        return nearest_distances(scenes, rooms, pass_over_own, same_classes)

    return Nearest(
        to(training), to(decoded) if decoded else None, to([*training, *decoded], same_classes=True)
    )

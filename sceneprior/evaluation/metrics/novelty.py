"""How new a room is: the distance of its layout to the nearest training room."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from sceneprior.evaluation.bootstrap import Estimate, mean_of_rooms
from sceneprior.evaluation.metric import Comparison, Metric, RoomSet, TableColumn
from sceneprior.geometry.turns import QUARTERS, quarter_rotation
from sceneprior.scene import Scene

MISSING_M = 1.0
"""What an object without a counterpart counts; a pair farther apart than this counts no more."""
NEAR_COPY_M = 0.15
"""A room nearer than this to a training room is a near copy of it."""
_CLASS_STEP = 1e6  # farther apart than any two boxes: other classes cost MISSING_M


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
    return _distance(np.minimum(cdist(_rows(a), _rows(b)), MISSING_M))


def _distance(costs: np.ndarray) -> float:
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
    scenes: Sequence[Scene], training: Sequence[Scene], own: Sequence[int] | None = None
) -> Float[np.ndarray, " scenes"]:
    """The layout distance of each scene to the nearest training room, in any of four quarter turns.

    The turns count because training turns its rooms, too. Exact and quick: most training rooms are
    ruled out by what each object would cost if it could choose freely.

    Args:
        training: Every training room; at least one beside the room's own.
        own: Where the scenes are training rooms: the row of each, which is passed over.
    """
    rooms = [_rows(room) for room in training]
    counts = np.array([len(room) for room in rooms])
    everything = np.concatenate([np.zeros((0, 7)), *rooms])
    starts = np.cumsum(counts) - counts
    nearest = np.empty(len(scenes))
    for row, scene in enumerate(scenes):
        best = np.inf
        placed = _rows(scene)
        for quarters in range(QUARTERS):
            costs = np.minimum(cdist(_turned(placed, quarters), everything), MISSING_M)
            bounds = _lower_bounds(costs, starts, counts)
            if own is not None:
                bounds[own[row]] = np.inf
            for room in np.argsort(bounds):
                if bounds[room] >= best:
                    break
                candidate = costs[:, starts[room] : starts[room] + counts[room]]
                best = min(best, _distance(candidate))
        nearest[row] = best
    return nearest


def _turned(rows: np.ndarray, quarters: int) -> np.ndarray:
    turn = quarter_rotation(quarters).T
    return np.hstack([rows[:, :3] @ turn, rows[:, 3:6] @ np.abs(turn), rows[:, 6:]])


def _lower_bounds(costs: np.ndarray, starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """What each training room costs at least: every object takes its cheapest partner freely."""
    mine = len(costs)
    # One more column, so that an empty room at the end has a place to start at.
    costs = np.hstack([costs, np.full((mine, 1), MISSING_M)])
    theirs = np.add.reduceat(costs.min(0, initial=MISSING_M), starts) * (counts > 0)
    ours = np.minimum.reduceat(costs, starts, axis=1)
    ours = np.where(counts > 0, ours, MISSING_M).sum(0)
    least = np.maximum(
        theirs + MISSING_M * np.maximum(mine - counts, 0),
        ours + MISSING_M * np.maximum(counts - mine, 0),
    )
    # A hair lower: sums in another order must not rule out an equally near room.
    return np.asarray(least / np.maximum(np.maximum(counts, mine), 1) - 1e-12)


def _nearest(rooms: RoomSet, comparison: Comparison) -> Estimate:
    return mean_of_rooms(rooms.nearest_training_m, rooms.counts)


def _near_copies(rooms: RoomSet, comparison: Comparison) -> Estimate:
    return mean_of_rooms(rooms.nearest_training_m < NEAR_COPY_M, rooms.counts, 1.0)


METRICS = (
    Metric(
        "nearest_training_m", "Distance to the nearest training room", "mean, metres", "none",
        "Novelty: mean layout distance (below) to the nearest of all training rooms; a training "
        "room passes itself over.",
        _nearest,
        protocol={
            "nearest_training_m": f"boxes paired within classes, {MISSING_M} m for a missing one, "
            f"four quarter turns; near copies: under {NEAR_COPY_M} m"
        },
        column=TableColumn(
            "nearest training room (m)", 2,
            "nearest training room: how far, on average; near 0 a method has learnt them by heart",
        ),
    ),
    Metric(
        "near_copy_share", "Near copies of a training room", "share of rooms", "lower",
        "Rooms nearer than 0.15 m to a training room.", _near_copies,
    ),
)  # fmt: skip

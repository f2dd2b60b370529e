"""Novelty: the layout distance between rooms, distances to the nearest training rooms, true and
decoded, and the share of near copies.

A larger distance is not better: incoherent rooms are far from every training room too. Only near
copies are a fault."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from sceneprior.core.boxes import QUARTERS, quarter_rotation
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import (
    GENERATED,
    Comparison,
    Estimate,
    Nearest,
    RoomSet,
    TableColumn,
    mean_of_rooms,
    metric,
)

MISSING_M = 1.0
"""Cost of an object without a counterpart, and the largest cost of a pair, in metres."""
_CLASS_STEP = 1e6  # exceeds all distances of boxes, so a pair of different classes costs MISSING_M
_MIRROR = np.diag([-1.0, 1.0, 1.0])
TURNS = tuple(
    quarter_rotation(quarters).T @ mirror
    for quarters in range(QUARTERS)
    for mirror in (np.eye(3), _MIRROR)
)
"""The four quarter turns of a room and of its mirror image, the augmentations of training."""


def _costs(placed: np.ndarray, others: np.ndarray) -> np.ndarray:
    # SciPy is imported here, since most commands import this module without comparing rooms.
    from scipy.spatial.distance import cdist

    return np.asarray(np.minimum(cdist(placed, others), MISSING_M))


def _total(costs: np.ndarray) -> float:
    """The least total cost of pairing the objects of two rooms one to one."""
    from scipy.optimize import linear_sum_assignment

    matched = float(costs[linear_sum_assignment(costs)].sum()) if min(costs.shape) else 0.0
    return matched + MISSING_M * (max(costs.shape) - min(costs.shape))


def _rows(scene: Scene) -> np.ndarray:
    """(objects, 7): centre, size, and the class index scaled so that only equal classes pair."""
    label = _CLASS_STEP * scene.class_indices[:, None]
    return np.hstack([scene.centers_m, scene.sizes_m, label])


def nearest_distances(
    scenes: Sequence[Scene],
    training: Sequence[Scene],
    pass_over_own: bool = False,
    as_copies: bool = False,
) -> Float[np.ndarray, " scenes"]:
    """Layout distance of each scene to the nearest training room, minimised over all of `TURNS`.

    The distance is the mean cost, in metres, of moving and resizing one room's furniture to match
    the other's. Objects are paired one to one within classes at minimum total cost. A pair costs
    the norm of (difference of centres, difference of sizes), at most 1 m; an object without a
    partner costs 1 m. The total is divided by the number of objects in the larger room: 0 for equal
    layouts, 1 for layouts without a common object. Two empty rooms are at distance 0.

    The search is exact. A lower bound, in which every object takes its cheapest partner, rules out
    most training rooms without an assignment. The distance of a scene that has no training room to
    be compared with is inf.

    Args:
        pass_over_own: Skip the training room with the scene's name, so that none meets itself.
        as_copies: Compare only with rooms of the same furniture, up to one object more or fewer,
            and average over pairs only: an unpaired object costs nothing.
    """
    rooms = _Rooms(training)
    names = np.array([room.name for room in training])
    nearest = np.full(len(scenes), np.inf)
    for row, scene in enumerate(scenes):
        allowed = np.ones(len(training), dtype=bool)
        if pass_over_own:
            allowed &= names != scene.name
        if as_copies:
            allowed &= rooms.hold_the_same(scene)
        if allowed.any():
            nearest[row] = rooms.nearest(scene, allowed, as_copies)[1]
    return nearest


def nearest_room(scene: Scene, training: Sequence[Scene]) -> tuple[int, float]:
    """Index of the training room nearest to a scene, and its distance as in `nearest_distances`.

    `training` must not be empty.
    """
    return _Rooms(training).nearest(scene, np.ones(len(training), dtype=bool))


class _Rooms:
    """Index of rooms for nearest-room searches."""

    def __init__(self, rooms: Sequence[Scene]):
        each = [_rows(room) for room in rooms]
        self.counts = np.array([len(room) for room in each], dtype=np.int64)
        self.objects = np.concatenate([np.zeros((0, 7)), *each])
        self.starts = np.cumsum(self.counts) - self.counts
        self.contents = [Counter(room.class_indices.tolist()) for room in rooms]

    def hold_the_same(self, scene: Scene) -> Bool[np.ndarray, " rooms"]:
        """True for rooms with a scene's furniture, up to one object more or fewer.

        Empty rooms match no scene, and an empty scene matches no room.
        """
        mine = Counter(scene.class_indices.tolist())
        odd = [((mine - theirs) + (theirs - mine)).total() for theirs in self.contents]
        fewest = np.minimum(self.counts, mine.total())
        return np.asarray((np.array(odd, dtype=int) <= 1) & (fewest > 0))

    def nearest(
        self, scene: Scene, allowed: Bool[np.ndarray, " rooms"], as_copies: bool = False
    ) -> tuple[int, float]:
        """Index and distance of the nearest allowed room; at least one must be allowed."""
        best, found, placed = np.inf, 0, _rows(scene)
        smaller = np.minimum(self.counts, len(placed))
        larger = np.maximum(self.counts, len(placed))
        # distance = (total cost - free) / number; as copies, the unpaired object is free.
        free = MISSING_M * (larger - smaller) * as_copies
        number = np.maximum(smaller if as_copies else larger, 1)
        for turn in TURNS:
            costs = _costs(_turned(placed, turn), self.objects)
            least = _lower_bounds(costs, self.starts, self.counts)
            # 1e-12 lower: a different order of summation must not rule out an equally near room.
            bounds = np.where(allowed, (least - free) / number - 1e-12, np.inf)
            for room in np.argsort(bounds):
                if bounds[room] >= best:
                    break
                start = self.starts[room]
                total = _total(costs[:, start : start + self.counts[room]])
                distance = float((total - free[room]) / number[room])
                if distance < best:
                    best, found = distance, int(room)
        return found, float(best)


def _turned(rows: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return np.hstack([rows[:, :3] @ turn, rows[:, 3:6] @ np.abs(turn), rows[:, 6:]])


def _lower_bounds(costs: np.ndarray, starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Lower bound on the total cost to each training room: each object's cheapest partner."""
    mine = len(costs)
    # `reduceat` needs a column at each start, even if the last room is empty. The extra column
    # belongs to the last room, where it adds 0 to the sum and never lowers a minimum.
    cheapest = np.append(costs.min(0, initial=MISSING_M), 0.0)
    theirs = np.add.reduceat(cheapest, starts) * (counts > 0)
    ours = np.minimum.reduceat(np.hstack([costs, np.full((mine, 1), MISSING_M)]), starts, axis=1)
    ours = np.where(counts > 0, ours, MISSING_M).sum(0)
    return np.asarray(
        np.maximum(
            theirs + MISSING_M * np.maximum(mine - counts, 0),
            ours + MISSING_M * np.maximum(counts - mine, 0),
        )
    )


def nearest_known(
    scenes: Sequence[Scene],
    training: Sequence[Scene],
    decoded: Sequence[Scene],
    pass_over_own: bool = False,
) -> Nearest:
    """Distances of each scene to the nearest true and, if any, decoded training room."""

    def to(rooms: Sequence[Scene], as_copies: bool = False) -> np.ndarray:
        return nearest_distances(scenes, rooms, pass_over_own, as_copies)

    return Nearest(
        to(training), to(decoded) if decoded else None, to([*training, *decoded], as_copies=True)
    )


NEAR_COPY_QUANTILE = 0.01
"""Share of real training rooms that count as near copies of another; it sets the threshold."""
THRESHOLD_ROOMS = 500
"""Largest number of training rooms for measuring the threshold; thousands would take minutes."""


def near_copy_threshold(training: Sequence[Scene]) -> float:
    """The distance in metres below which a room is a near copy of a training room.

    It is the 1% quantile of the distances of training rooms to the nearest other training room with
    the same furniture, up to one object more or fewer; infinite distances count. If the quantile is
    infinite (hardly any two rooms share their furniture), it is 0, and no room is a near copy.
    """
    rows = np.linspace(0, len(training) - 1, min(len(training), THRESHOLD_ROOMS)).astype(int)
    rooms = [training[row] for row in rows]
    distances = nearest_distances(rooms, training, pass_over_own=True, as_copies=True)
    threshold = float(np.quantile(distances, NEAR_COPY_QUANTILE, method="higher"))
    return threshold if np.isfinite(threshold) else 0.0


@metric(
    "nearest_training_m", "Distance to the nearest training room", "mean, metres", "none",
    protocol={
        "nearest_training_m": f"boxes paired within classes, {MISSING_M} m for a missing one, "
        "four quarter turns, mirrored or not"
    },
    column=TableColumn(
        "nearest training room (m)", 2,
        "nearest training room: mean layout distance; near 0, a method has memorised training "
        "rooms, and a distance above that of real rooms is no better",
    ),
)  # fmt: skip
def _nearest(rooms: RoomSet, comparison: Comparison) -> Estimate:
    return mean_of_rooms(rooms.nearest.training_m, rooms.counts)


@metric(
    "nearest_decoded_m", "Distance to the nearest decoded training room", "mean, metres", "none"
)
def _nearest_decoded(rooms: RoomSet, comparison: Comparison) -> Estimate | None:
    distances = rooms.nearest.decoded_m
    return None if distances is None else mean_of_rooms(distances, rooms.counts)


@metric(
    "near_copy_share", "Near copies of a training room", "share of rooms", "lower",
    protocol={
        "near_copy_share": f"under near_copy_m, the {NEAR_COPY_QUANTILE:.0%} quantile of the "
        f"distances of real training rooms (at most {THRESHOLD_ROOMS}) to the nearest other one; "
        "the same classes, each as often, at most one object added or left out"
    },
    column=TableColumn(
        "near copies", 2,
        "near copies: share of rooms with the furniture of one training room at its places, "
        "one object more or fewer allowed",
    ),
)  # fmt: skip
def _near_copy_share(rooms: RoomSet, comparison: Comparison) -> Estimate:
    copies = rooms.nearest.as_copies_m < comparison.near_copy_m
    return mean_of_rooms(copies, rooms.counts, 1.0)


@metric(
    "near_copy_excess", "Near copies beyond those among real rooms", "share of rooms", "lower",
    GENERATED,
)  # fmt: skip
def _near_copy_excess(rooms: RoomSet, comparison: Comparison) -> Estimate:
    real = _near_copy_share(comparison.test, comparison)
    return _near_copy_share(rooms, comparison).combined(real, np.subtract)

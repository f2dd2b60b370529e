"""Novelty: the layout distance between rooms, distances to the nearest training rooms, true and
decoded, and the share of near copies.

A larger distance is not better: incoherent rooms are far from every training room too. Only near
copies are a fault."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sceneprior.core.boxes import QUARTERS, quarter_rotation
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import (
    GENERATED,
    Comparison,
    Estimate,
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


class KnownRooms:
    """Rooms among which the one nearest to a scene is searched, by their layouts.

    The layout distance is the mean cost, in metres, of moving and resizing one room's furniture to
    match the other's, minimised over all of `TURNS`. Objects are paired one to one within classes
    at minimum total cost. A pair costs the norm of (difference of centres, difference of sizes), at
    most 1 m; an object without a partner costs 1 m. The total is divided by the number of objects
    in the larger room: 0 for equal layouts, 1 for layouts without a common object. Two empty rooms
    are at distance 0.
    """

    def __init__(self, rooms: Sequence[Scene]):
        each = [_rows(room) for room in rooms]
        self.names = np.array([room.name for room in rooms], dtype=object)
        self.counts = np.array([len(room) for room in each], dtype=np.int64)
        self.objects = np.concatenate([np.zeros((0, 7)), *each])
        self.starts = np.cumsum(self.counts) - self.counts
        self.contents = [Counter(room.class_indices.tolist()) for room in rooms]

    def nearest(
        self, scene: Scene, pass_over_own: bool = False, as_copies: bool = False
    ) -> tuple[int, float]:
        """Index and distance of the nearest room; the distance is inf if no room is compared.

        The search is exact. A lower bound, in which every object takes its cheapest partner, rules
        out most rooms without an assignment.

        Args:
            pass_over_own: Skip the room with the scene's name, so that none meets itself.
            as_copies: Compare only with rooms of the same furniture, up to one object more or
                fewer, and average over pairs only: an unpaired object costs nothing. Empty rooms
                match no scene, and an empty scene matches no room.
        """
        # SciPy is imported here, since most commands import this module without comparing rooms.
        from scipy.optimize import linear_sum_assignment
        from scipy.spatial.distance import cdist

        placed = _rows(scene)
        smaller, larger = (take(self.counts, len(placed)) for take in (np.minimum, np.maximum))
        skipped = (self.names == scene.name) & pass_over_own
        if as_copies:
            mine = Counter(scene.class_indices.tolist())
            odd = [((mine - theirs) + (theirs - mine)).total() for theirs in self.contents]
            skipped |= (np.array(odd, dtype=int) > 1) | (smaller == 0)
        # distance = (total cost - free) / number; as copies, the unpaired object is free.
        free = MISSING_M * (larger - smaller) * as_copies
        number = np.maximum(smaller if as_copies else larger, 1)
        best, found = np.inf, 0
        for turn in TURNS if not skipped.all() else ():
            turned = [placed[:, :3] @ turn, placed[:, 3:6] @ np.abs(turn), placed[:, 6:]]
            costs = np.minimum(cdist(np.hstack(turned), self.objects), MISSING_M)
            # 1e-12 lower: a different order of summation must not rule out an equally near room.
            bounds = (self._least_costs(costs) - free) / number - 1e-12
            bounds[skipped] = np.inf
            for room in np.argsort(bounds):
                if bounds[room] >= best:
                    break
                own = costs[:, self.starts[room] : self.starts[room] + self.counts[room]]
                total = own[linear_sum_assignment(own)].sum()
                total += MISSING_M * (larger[room] - smaller[room]) - free[room]
                if total / number[room] < best:
                    best, found = float(total / number[room]), int(room)
        return found, best

    def _least_costs(self, costs: Float[np.ndarray, "mine objects"]) -> Float[np.ndarray, " rooms"]:
        """Lower bound on the total cost to each room: each object's cheapest partner."""
        mine = len(costs)
        # `reduceat` needs a column at each start, even if the last room is empty. The extra column
        # belongs to the last room, where it adds 0 to the sum and never lowers a minimum.
        cheapest = np.append(costs.min(0, initial=MISSING_M), 0.0)
        theirs = np.add.reduceat(cheapest, self.starts) * (self.counts > 0)
        padded = np.hstack([costs, np.full((mine, 1), MISSING_M)])
        ours = np.minimum.reduceat(padded, self.starts, axis=1)
        ours = np.where(self.counts > 0, ours, MISSING_M).sum(0)
        return np.maximum(
            theirs + MISSING_M * np.maximum(mine - self.counts, 0),
            ours + MISSING_M * np.maximum(self.counts - mine, 0),
        )


def _rows(scene: Scene) -> Float[np.ndarray, "objects 7"]:
    """Centre, size, and the class index scaled so that only equal classes pair."""
    label = _CLASS_STEP * scene.class_indices[:, None]
    return np.hstack([scene.centers_m, scene.sizes_m, label])


def nearest_distances(
    scenes: Sequence[Scene],
    training: Sequence[Scene],
    pass_over_own: bool = False,
    as_copies: bool = False,
) -> Float[np.ndarray, " scenes"]:
    """Layout distance of each scene to the nearest training room; see `KnownRooms.nearest`."""
    rooms = KnownRooms(training)
    return np.array([rooms.nearest(scene, pass_over_own, as_copies)[1] for scene in scenes])


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
    protocol=f"boxes paired within classes, {MISSING_M} m for a missing one, "
    "four quarter turns, mirrored or not",
    column=TableColumn(
        "nearest training room (m)", 2,
        "nearest training room: mean layout distance; near 0, a method has memorised training "
        "rooms, and a distance above that of real rooms is no better",
    ),
)  # fmt: skip
def _nearest(rooms: RoomSet, comparison: Comparison) -> Estimate:
    own = comparison.is_training_set(rooms)
    return mean_of_rooms(nearest_distances(rooms.scenes, comparison.train, own), rooms.counts)


@metric(
    "nearest_decoded_m", "Distance to the nearest decoded training room", "mean, metres", "none"
)
def _nearest_decoded(rooms: RoomSet, comparison: Comparison) -> Estimate | None:
    if not comparison.decoded:
        return None
    own = comparison.is_training_set(rooms)
    return mean_of_rooms(nearest_distances(rooms.scenes, comparison.decoded, own), rooms.counts)


@metric(
    "near_copy_share", "Near copies of a training room", "share of rooms", "lower",
    protocol=f"under near_copy_m, the {NEAR_COPY_QUANTILE:.0%} quantile of the "
    f"distances of real training rooms (at most {THRESHOLD_ROOMS}) to the nearest other one; "
    "the same classes, each as often, at most one object added or left out",
    column=TableColumn(
        "near copies", 2,
        "near copies: share of rooms with the furniture of one training room at its places, "
        "one object more or fewer allowed",
    ),
)  # fmt: skip
def _near_copy_share(rooms: RoomSet, comparison: Comparison) -> Estimate:
    known, own = [*comparison.train, *comparison.decoded], comparison.is_training_set(rooms)
    distances = nearest_distances(rooms.scenes, known, own, as_copies=True)
    return mean_of_rooms(distances < comparison.near_copy_m, rooms.counts, 1.0)


@metric(
    "near_copy_excess", "Near copies beyond those among real rooms", "share of rooms", "lower",
    GENERATED,
)  # fmt: skip
def _near_copy_excess(rooms: RoomSet, comparison: Comparison) -> Estimate:
    columns = comparison.columns
    ours, real = (columns[name]["near_copy_share"] for name in ("generated", "test"))
    return ours.combined(real, np.subtract)

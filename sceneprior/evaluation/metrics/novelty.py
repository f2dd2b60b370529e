"""Novelty: distances to training rooms, true and decoded, and the share of near copies.

A larger distance is not better: incoherent rooms are far from every training room too. Only near
copies are a fault.
"""

from collections.abc import Sequence

import numpy as np

from sceneprior.core.scene import Scene
from sceneprior.evaluation.bootstrap import Estimate, mean_of_rooms
from sceneprior.evaluation.layout_distance import MISSING_M, nearest_distances
from sceneprior.evaluation.metric import GENERATED, Comparison, Metric, RoomSet, TableColumn

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


def _nearest(rooms: RoomSet, comparison: Comparison) -> Estimate:
    return mean_of_rooms(rooms.nearest.training_m, rooms.counts)


def _nearest_decoded(rooms: RoomSet, comparison: Comparison) -> Estimate | None:
    distances = rooms.nearest.decoded_m
    return None if distances is None else mean_of_rooms(distances, rooms.counts)


def _near_copy_share(rooms: RoomSet, comparison: Comparison) -> Estimate:
    copies = rooms.nearest.as_copies_m < comparison.near_copy_m
    return mean_of_rooms(copies, rooms.counts, 1.0)


def _near_copy_excess(rooms: RoomSet, comparison: Comparison) -> Estimate:
    ours = _near_copy_share(rooms, comparison)
    return ours.minus(_near_copy_share(comparison.test, comparison))


METRICS = (
    Metric(
        "nearest_training_m", "Distance to the nearest training room", "mean, metres", "none",
        _nearest,
        protocol={
            "nearest_training_m": f"boxes paired within classes, {MISSING_M} m for a missing one, "
            "four quarter turns, mirrored or not"
        },
        column=TableColumn(
            "nearest training room (m)", 2,
            "nearest training room: mean layout distance; near 0, a method has memorised training "
            "rooms, and a distance above that of real rooms is no better",
        ),
    ),
    Metric(
        "nearest_decoded_m", "Distance to the nearest decoded training room", "mean, metres",
        "none",
        _nearest_decoded,
    ),
    Metric(
        "near_copy_share", "Near copies of a training room", "share of rooms", "lower",
        _near_copy_share,
        protocol={
            "near_copy_share": f"under near_copy_m, the {NEAR_COPY_QUANTILE:.0%} quantile of the "
            f"distances of real training rooms (at most {THRESHOLD_ROOMS}) to the nearest other "
            "one; "
            "the same classes, each as often, at most one object added or left out"
        },
        column=TableColumn(
            "near copies", 2,
            "near copies: share of rooms with the furniture of one training room at its places, "
            "one object more or fewer allowed",
        ),
    ),
    Metric(
        "near_copy_excess", "Near copies beyond those among real rooms", "share of rooms", "lower",
        _near_copy_excess, GENERATED,
    ),
)  # fmt: skip

"""How new rooms are: distances to training rooms, true and decoded, and the share of copies."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from sceneprior.evaluation.bootstrap import Estimate, mean_of_rooms
from sceneprior.evaluation.layout_distance import MISSING_M, nearest_distances
from sceneprior.evaluation.metric import GENERATED, Comparison, Metric, RoomSet, TableColumn
from sceneprior.scene import Scene

NEAR_COPY_QUANTILE = 0.01
"""Share of real training rooms that lie nearer to another one than a near copy may."""
THRESHOLD_ROOMS = 500
"""Training rooms, at most, that the threshold is measured on: thousands would take minutes."""


def near_copy_threshold(training: Sequence[Scene]) -> float:
    """The distance that two different real rooms seldom go below, in metres.

    It is the 1% quantile of the layout distances of training rooms to the nearest other training
    room; 0, so that nothing is a near copy, where there is no other.
    """
    rows = np.linspace(0, len(training) - 1, min(len(training), THRESHOLD_ROOMS)).astype(int)
    rooms = [training[row] for row in rows]
    distances = nearest_distances(rooms, training, pass_over_own=True)
    known = distances[np.isfinite(distances)]
    return float(np.quantile(known, NEAR_COPY_QUANTILE)) if len(known) else 0.0


def near_copies(rooms: RoomSet, comparison: Comparison) -> Bool[np.ndarray, " rooms"]:
    """Which rooms hold the furniture of one training room, true or decoded, at its places."""
    return np.asarray(rooms.nearest.same_classes_m < comparison.near_copy_m)


def _nearest(rooms: RoomSet, comparison: Comparison) -> Estimate:
    return mean_of_rooms(rooms.nearest.training_m, rooms.counts)


def _nearest_decoded(rooms: RoomSet, comparison: Comparison) -> Estimate | None:
    distances = rooms.nearest.decoded_m
    return None if distances is None else mean_of_rooms(distances, rooms.counts)


def _near_copy_share(rooms: RoomSet, comparison: Comparison) -> Estimate:
    return mean_of_rooms(near_copies(rooms, comparison), rooms.counts, 1.0)


def _nearest_decoded_ratio(rooms: RoomSet, comparison: Comparison) -> Estimate | None:
    ours = _nearest_decoded(rooms, comparison)
    real = _nearest_decoded(comparison.test, comparison)
    return None if ours is None or real is None else ours.over(real)


def _near_copy_excess(rooms: RoomSet, comparison: Comparison) -> Estimate:
    ours = _near_copy_share(rooms, comparison)
    return ours.minus(_near_copy_share(comparison.test, comparison))


METRICS = (
    Metric(
        "nearest_training_m", "Distance to the nearest training room", "mean, metres", "none",
        "Novelty: mean layout distance (below) to the nearest of all training rooms; a training "
        "room passes itself over.",
        _nearest,
        protocol={
            "nearest_training_m": f"boxes paired within classes, {MISSING_M} m for a missing one, "
            "four quarter turns, mirrored or not"
        },
        column=TableColumn(
            "nearest training room (m)", 2,
            "nearest training room: how far, on average; near 0 a method has learnt them by heart",
        ),
    ),
    Metric(
        "nearest_decoded_m", "Distance to the nearest decoded training room", "mean, metres",
        "none",
        "The same to the nearest training room as the prior decodes it, which is what it "
        "remembers; left out where no decoded training rooms are known.",
        _nearest_decoded,
    ),
    Metric(
        "nearest_decoded_training_ratio", "The same, over that of real rooms", "1: as new as real",
        "higher", "`nearest_decoded_m` of generated rooms over that of test rooms.",
        _nearest_decoded_ratio, GENERATED,
        column=TableColumn(
            "new", 2,
            "new: distance to the nearest decoded training room over that of real test rooms",
        ),
    ),
    Metric(
        "near_copy_share", "Near copies of a training room", "share of rooms", "lower",
        "Rooms that hold the same number of objects of each class as one training room, true or "
        "decoded, nearer to it than `near_copy_m` of the protocol: the 1% quantile of the "
        "distances of real training rooms to the nearest other one.",
        _near_copy_share,
        protocol={
            "near_copy_share": f"under near_copy_m, the {NEAR_COPY_QUANTILE:.0%} quantile of the "
            f"distances of real training rooms (at most {THRESHOLD_ROOMS}) to the nearest other, "
            "the same classes, each as often"
        },
        column=TableColumn(
            "near copies", 2,
            "near copies: share of rooms with the furniture of one training room at its places",
        ),
    ),
    Metric(
        "near_copy_excess", "Near copies beyond those among real rooms", "share of rooms", "lower",
        "`near_copy_share` of generated rooms less that of test rooms.",
        _near_copy_excess, GENERATED,
    ),
)  # fmt: skip

"""Metrics of spatial relations: the gaps between classes, compared with those in real rooms.

They detect, for example, a nightstand far from every bed, which metrics of single objects
(frequencies, sizes, distances to walls) miss.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sceneprior.core.classes import VOID, label_set
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import (
    AGAINST_TEST,
    GENERATED,
    Comparison,
    Estimate,
    RoomSet,
    TableColumn,
    metric,
)

PAIR_SHARE = 0.05
"""Share of the real rooms that must hold an ordered pair of classes for the pair to count."""
FAR_M = 3.0
"""Largest gap in metres, InstructScene's limit of a relation between two objects. Larger gaps are
clipped to it, and a set that lacks a pair of classes is treated as having one such pair with this
gap."""
NEAR_M = 0.3
"""Gap in metres up to which the table of pairs counts two objects as near."""
LISTED = 10
"""Number of pairs in the table of pairs."""


class Gaps(NamedTuple):
    """Gaps from the objects of one class to the nearest object of another."""

    gaps_m: Float[np.ndarray, " objects"]
    room: Int[np.ndarray, " objects"]
    """Index of the room that holds each object."""


Pair = tuple[int, int]


def nearest_gaps(scenes: Sequence[Scene]) -> dict[Pair, Gaps]:
    """Gaps in metres by ordered pair of classes (a, b), at most `FAR_M`.

    For each object of class a, the gap is the distance on the floor to the nearest other object of
    class b in its room, between their footprints (axis-aligned rectangles); 0 if they touch or
    overlap. Void objects are ignored. Pairs that no room holds are left out.
    """
    found: dict[Pair, tuple[list[float], list[int]]] = {}
    for row, scene in enumerate(scenes):
        known = scene.class_indices != VOID
        classes = scene.class_indices[known]
        centers, sizes = scene.centers_m[known][:, [0, 2]], scene.sizes_m[known][:, [0, 2]]
        apart = np.abs(centers[:, None] - centers) - (sizes[:, None] + sizes) / 2
        gaps = np.linalg.norm(np.maximum(apart, 0), axis=-1).clip(max=FAR_M)
        np.fill_diagonal(gaps, np.inf)
        for b in np.unique(classes):
            nearest = gaps[:, classes == b].min(axis=1)
            for item in np.flatnonzero(np.isfinite(nearest)):
                values, rooms = found.setdefault((int(classes[item]), int(b)), ([], []))
                values.append(float(nearest[item]))
                rooms.append(row)
    return {pair: Gaps(np.array(gaps), np.array(rooms)) for pair, (gaps, rooms) in found.items()}


def common_pairs(scenes: Sequence[Scene]) -> list[Pair]:
    """Ordered pairs of classes that at least `PAIR_SHARE` of the rooms hold."""
    return sorted(
        pair
        for pair, gaps in nearest_gaps(scenes).items()
        if len(np.unique(gaps.room)) >= PAIR_SHARE * len(scenes)
    )


def wasserstein(
    a: Float[np.ndarray, " n"],
    b: Float[np.ndarray, " m"],
    weights_a: Int[np.ndarray, "resamples n"],
    weights_b: Int[np.ndarray, "resamples m"],
) -> Float[np.ndarray, " resamples"]:
    """Wasserstein-1 distance between two weighted 1D samples, for many weightings at once.

    Weights are the multiplicities of the values. The distance is the area between the two
    cumulative distributions; NaN if all weights of a side are 0.
    """
    values = np.concatenate([a, b])
    order = np.argsort(values)
    steps = np.diff(values[order])
    with np.errstate(invalid="ignore"):
        part_a = weights_a / weights_a.sum(axis=1, keepdims=True)
        part_b = weights_b / weights_b.sum(axis=1, keepdims=True)
    difference = np.concatenate([part_a, -part_b], axis=1)[:, order].cumsum(axis=1)[:, :-1]
    return np.asarray(np.abs(difference) @ steps)


class PairDistances(NamedTuple):
    """Wasserstein distance in metres between a set's gaps and the test rooms' gaps, per pair of
    classes."""

    pairs: list[Pair]
    """The pairs of `common_pairs` that the test rooms hold."""
    values_m: Float[np.ndarray, " pairs"]
    resamples_m: Float[np.ndarray, "pairs resamples"]
    weights: Float[np.ndarray, " pairs"]
    """Each pair's share of all gaps in the test rooms; distances of rare pairs are mostly noise."""


def pair_distances(rooms: RoomSet, comparison: Comparison) -> PairDistances:
    """Compute `PairDistances`; a set without a pair is treated as having one gap of `FAR_M`."""
    mine, theirs = nearest_gaps(rooms.scenes), nearest_gaps(comparison.test.scenes)
    pairs = [pair for pair in common_pairs(comparison.real) if pair in theirs]
    absent = Gaps(np.array([FAR_M]), np.array([0]))
    values, resamples = [], []
    for pair in pairs:
        a, b = mine.get(pair, absent), theirs[pair]
        once = np.ones((1, len(a.gaps_m)), int), np.ones((1, len(b.gaps_m)), int)
        weights_a = (
            rooms.counts[:, a.room] if pair in mine else np.ones((len(rooms.counts), 1), int)
        )
        values.append(wasserstein(a.gaps_m, b.gaps_m, *once)[0])
        resamples.append(
            wasserstein(a.gaps_m, b.gaps_m, weights_a, comparison.test.counts[:, b.room])
        )
    shape = len(pairs), len(rooms.counts)
    number = np.array([len(theirs[pair].gaps_m) for pair in pairs], dtype=float)
    weights = number / max(number.sum(), 1)
    return PairDistances(pairs, np.array(values), np.reshape(resamples, shape), weights)


@metric(
    "relation_distance_m", "Relations: gaps between classes", "mean over pairs, metres", "closer",
    AGAINST_TEST,
    protocol={
        "relation_distance_m": f"ordered pairs that {PAIR_SHARE:.0%} of the real training and "
        f"val rooms have, gaps between footprints up to {FAR_M} m, Wasserstein-1 distance from "
        "the test rooms' gaps, mean over pairs weighted by their number in the test rooms"
    },
    column=TableColumn(
        "relations (m)", 3,
        "relations: mean Wasserstein distance of gaps between classes from the test rooms'",
    ),
)  # fmt: skip
def relation_distance(rooms: RoomSet, comparison: Comparison) -> Estimate:
    found = pair_distances(rooms, comparison)
    if not found.pairs:
        return Estimate(None, np.zeros(0))
    # A resample may hold no room with a rare pair; the mean is then over the other pairs. A
    # resample of few rooms may hold no pair at all, and is left out.
    known = np.isfinite(found.resamples_m)
    weight = found.weights @ known
    total = found.weights @ np.where(known, found.resamples_m, 0)
    means = total[weight > 0] / weight[weight > 0]
    return Estimate(float(found.weights @ found.values_m), means, 0.0)


@metric(
    "relation_ratio", "The same, over that of real rooms", "1: as near as real", "lower", GENERATED
)
def _ratio(rooms: RoomSet, comparison: Comparison) -> Estimate:
    real = comparison.columns["train_rooms"]["relation_distance_m"]
    return relation_distance(rooms, comparison).combined(real, np.divide, low=0.0)


def furthest_pairs(rooms: RoomSet, train: RoomSet, comparison: Comparison) -> list[dict[str, Any]]:
    """The `LISTED` pairs that contribute most to the excess over real training rooms' distance.

    Each row holds the pair (`of`, `to`), the distance of the set and of real training rooms
    (`distance_m`, `train_m`), and the share of objects within `NEAR_M` of the nearest one, in the
    set (`near`; None if it lacks the pair) and in the test rooms (`near_test`).
    """
    found, real = pair_distances(rooms, comparison), pair_distances(train, comparison)
    beyond = found.weights * (found.values_m - real.values_m)
    names = label_set(comparison.real[0].label_set)
    gaps = nearest_gaps(rooms.scenes), nearest_gaps(comparison.test.scenes)

    def near(which: dict[Pair, Gaps], pair: Pair) -> float | None:
        return float((which[pair].gaps_m <= NEAR_M).mean()) if pair in which else None

    return [
        {
            "of": names[found.pairs[row][0]],
            "to": names[found.pairs[row][1]],
            "distance_m": float(found.values_m[row]),
            "train_m": float(real.values_m[row]),
            "near": near(gaps[0], found.pairs[row]),
            "near_test": near(gaps[1], found.pairs[row]),
        }
        for row in np.argsort(-beyond, kind="stable")[:LISTED]
    ]

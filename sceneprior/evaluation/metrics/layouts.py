"""Layouts, by the relations of boxes: the accuracy of a classifier that separates a set's layouts
from real ones, and the gaps between classes, compared with those in real rooms.

The accuracy is 0.5 if the sets are indistinguishable, and 1 if every room is classified correctly.
Copies of real rooms pass as real, so read it together with `near_copy_share`. The gaps detect, for
example, a nightstand far from every bed, which metrics of single objects (frequencies, sizes,
distances to walls) miss.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sceneprior.core.classes import label_set
from sceneprior.core.scene import Scene
from sceneprior.evaluation.geometry import box_pairs
from sceneprior.evaluation.metric import (
    AGAINST_TEST,
    GENERATED,
    Comparison,
    Estimate,
    RoomSet,
    TableColumn,
    mean_of_rooms,
    mean_of_shares,
    metric,
    ratio,
    resample_counts,
)
from sceneprior.evaluation.metrics.picture_classifiers import FOLDS

JITTER_M = 0.07
"""Standard deviation of the noise added to every centre and size of both sets. Real boxes touch
walls and each other exactly; the noise hides this, so that layouts are compared. Larger values hide
more of the layout."""
TREES = 300
FEW_TEST_ROOMS = 150
"""With fewer test rooms than this, a note states the width of the interval."""
ABSENT = -1.0
"""Feature value for classes that a room does not hold; other features, except heights, are at
least 0."""


def layout_features(
    centers_m: Float[np.ndarray, "objects 3"],
    sizes_m: Float[np.ndarray, "objects 3"],
    object_class: Int[np.ndarray, " objects"],
    classes: int,
) -> Float[np.ndarray, " features"]:
    """Features of a room's layout, in metres, that the classifier reads.

    They are invariant to quarter turns, mirroring, translation and the order of the objects.

    Per class: the number of objects; the mean height of their centres; the mean distance to the
    nearest edge of the rectangle around all furniture, and to the nearest edge along the other axis
    (both are 0 in a corner). Per pair of classes, over all pairs of objects: the smallest gap
    between footprints; the largest share of the smaller box's volume in the intersection; the
    smallest misalignment, that is the smaller difference of the centres along x or z.
    """
    single = np.full((3, classes), ABSENT)
    pairs = np.full((3, classes, classes), ABSENT)
    counts = np.bincount(object_class, minlength=classes).astype(float)
    if len(object_class):
        low, high = centers_m - sizes_m / 2, centers_m + sizes_m / 2
        to_edges = np.minimum(low - low.min(0), high.max(0) - high)[:, ::2]
        described = np.column_stack([centers_m[:, 1], to_edges.min(1), to_edges.max(1)])
        for name in np.unique(object_class):
            single[:, name] = described[object_class == name].mean(0)
        found = box_pairs(centers_m, sizes_m)
        one, other = np.sort([object_class[rows] for rows in found.rows], axis=0)
        # The wanted value is sorted last, because the last value written to a pair is kept.
        for which, values, wanted in (
            (0, found.gaps_m, -found.gaps_m),
            (1, found.shares, found.shares),
            (2, found.apart_m.min(1), -found.apart_m.min(1)),
        ):
            order = np.argsort(wanted)
            pairs[which, one[order], other[order]] = values[order]
    upper = np.triu_indices(classes)
    return np.concatenate([counts, single.ravel(), *(part[upper] for part in pairs)])


def jittered_features(
    scenes: Sequence[Scene], seed: tuple[int, ...]
) -> Float[np.ndarray, "rooms features"]:
    """`layout_features` of rooms with noise of `JITTER_M` added to their boxes."""
    rng = np.random.default_rng(seed)
    rows = []
    for scene in scenes:
        moved = scene.centers_m + rng.normal(0, JITTER_M, scene.centers_m.shape)
        resized = scene.sizes_m + rng.normal(0, JITTER_M, scene.sizes_m.shape)
        sizes = np.maximum(resized, JITTER_M / 2)  # keeps sizes positive, even of flat rugs
        classes = len(label_set(scene.label_set))
        rows.append(layout_features(moved, sizes, scene.class_indices, classes))
    return np.stack(rows)


def boosted_trees(
    features: Float[np.ndarray, "rooms features"],
    labels: Int[np.ndarray, " rooms"],
    others: Float[np.ndarray, "others features"],
    seed: int,
) -> Int[np.ndarray, " others"]:
    """Train gradient boosting on labelled rooms and predict the labels of others.

    Each split considers a random subset of the features. Both labels have the same total weight.
    """
    from sklearn.ensemble import GradientBoostingClassifier

    varied = features.std(0) > 0  # most pairs of classes never occur together
    if not varied.any():
        return np.zeros(len(others), dtype=int)
    model = GradientBoostingClassifier(
        n_estimators=TREES, max_features="sqrt", random_state=seed % 2**32
    )
    weights = 1 / np.bincount(labels)[labels]
    model.fit(features[:, varied], labels, sample_weight=weights * len(labels) / 2)
    return np.asarray(model.predict(others[:, varied]), dtype=int)


@metric(
    "layout_classifier_accuracy", "Classifier accuracy, layouts", "", "half", AGAINST_TEST,
    protocol=f"gradient boosting ({TREES} trees, depth 3, square root "
    f"of the features per split), noise of {JITTER_M} m; trained on all real training and "
    f"val rooms and {FOLDS - 1}/{FOLDS} of the set (at most as many rooms), evaluated on "
    "the test rooms and the rest of the set; equal total weight for real and other rooms; "
    "interval: over evaluated rooms, classifiers not retrained",
    column=TableColumn(
        "layout classifier", 2,
        "layout classifier: accuracy of a classifier of boxes and their relations",
    ),
)  # fmt: skip
def layout_classifier_accuracy(rooms: RoomSet, comparison: Comparison) -> Estimate:
    from sklearn.model_selection import KFold

    scenes, counts = rooms.scenes, rooms.counts
    real = [*comparison.train, *comparison.val]
    if comparison.is_training_set(rooms):
        # To score the real training rooms, the classifier separates two halves of the real rooms.
        order = np.random.default_rng((comparison.seed, 3)).permutation(len(real))
        halves = np.array_split(order, 2)
        scenes, real = ([real[row] for row in half] for half in halves)
        counts = resample_counts(len(scenes), len(counts) - 1, (comparison.seed, 4))
    test, seed = comparison.test, comparison.seed
    if min(len(scenes), len(real)) < 2:
        return Estimate(np.full(len(counts), np.nan))
    generated = jittered_features(scenes, (seed, 0))
    judged = jittered_features(test.scenes, (seed, 1))
    learnt = jittered_features(real, (seed, 2))
    right, right_test = np.zeros(len(scenes), dtype=int), np.zeros(len(judged), dtype=int)
    folds = KFold(min(FOLDS, len(scenes)), shuffle=True, random_state=seed % 2**32)
    for number, (known, fresh) in enumerate(folds.split(generated)):
        features = np.concatenate([learnt, generated[known[: len(learnt)]]])
        labels = np.repeat([0, 1], [len(learnt), len(features) - len(learnt)])
        others = np.concatenate([judged, generated[fresh]])
        answers = boosted_trees(features, labels, others, FOLDS * seed + number)
        right_test += answers[: len(judged)] == 0
        right[fresh] = answers[len(judged) :] == 1
    of_test = ratio(right_test, np.full(len(judged), folds.n_splits), test.counts)
    return mean_of_shares(mean_of_rooms(right, counts), of_test)


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
    overlap. Pairs that no room holds are left out.
    """
    found: dict[Pair, tuple[list[float], list[int]]] = {}
    for row, scene in enumerate(scenes):
        classes, pairs = scene.class_indices, box_pairs(scene.centers_m, scene.sizes_m)
        gaps = np.full((len(classes), len(classes)), np.inf)
        gaps[pairs.rows] = gaps[pairs.rows[::-1]] = pairs.gaps_m.clip(max=FAR_M)
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
    """Wasserstein distances between a set's gaps and the test rooms' gaps, per pair of classes."""

    gaps: tuple[dict[Pair, Gaps], dict[Pair, Gaps]]
    """Gaps of the set and of the test rooms."""
    pairs: list[Pair]
    """The pairs of `common_pairs` that the test rooms hold."""
    values_m: Float[np.ndarray, "pairs sets"]
    """Distances of the rooms themselves (column 0) and of each resample."""
    weights: Float[np.ndarray, " pairs"]
    """Each pair's share of all gaps in the test rooms; distances of rare pairs are mostly noise."""


def pair_distances(rooms: RoomSet, comparison: Comparison) -> PairDistances:
    """Compute `PairDistances`; a set without a pair is treated as having one gap of `FAR_M`."""
    mine, theirs = nearest_gaps(rooms.scenes), nearest_gaps(comparison.test.scenes)
    real = [*comparison.train, *comparison.val]
    pairs = [pair for pair in common_pairs(real) if pair in theirs]
    values = np.zeros((len(pairs), len(rooms.counts)))
    for row, pair in enumerate(pairs):
        a_m, a_weights = np.array([FAR_M]), np.ones((len(rooms.counts), 1), int)
        if pair in mine:
            a_m, a_weights = mine[pair].gaps_m, rooms.counts[:, mine[pair].room]
        b = theirs[pair]
        values[row] = wasserstein(a_m, b.gaps_m, a_weights, comparison.test.counts[:, b.room])
    number = np.array([len(theirs[pair].gaps_m) for pair in pairs], dtype=float)
    return PairDistances((mine, theirs), pairs, values, number / max(number.sum(), 1))


@metric(
    "relation_distance_m", "Relations: gaps between classes", "mean over pairs, metres", "closer",
    AGAINST_TEST,
    protocol=f"ordered pairs that {PAIR_SHARE:.0%} of the real training and "
    f"val rooms have, gaps between footprints up to {FAR_M} m, Wasserstein-1 distance from "
    "the test rooms' gaps, mean over pairs weighted by their number in the test rooms",
    column=TableColumn(
        "relations (m)", 3,
        "relations: mean Wasserstein distance of gaps between classes from the test rooms'",
    ),
)  # fmt: skip
def relation_distance(rooms: RoomSet, comparison: Comparison) -> Estimate:
    found = pair_distances(rooms, comparison)
    # A resample may hold no room with a rare pair; the mean is then over the other pairs.
    known = np.isfinite(found.values_m)
    total = found.weights @ np.where(known, found.values_m, 0)
    with np.errstate(invalid="ignore"):
        return Estimate(total / (found.weights @ known), 0.0)


@metric(
    "relation_ratio", "The same, over that of real rooms", "1: as near as real", "lower", GENERATED
)
def _ratio(rooms: RoomSet, comparison: Comparison) -> Estimate:
    real = comparison.columns["train_rooms"]["relation_distance_m"]
    ours = comparison.columns["generated"]["relation_distance_m"]
    return ours.combined(real, np.divide, low=0.0)


def furthest_pairs(rooms: RoomSet, train: RoomSet, comparison: Comparison) -> list[dict[str, Any]]:
    """The `LISTED` pairs that contribute most to the excess over real training rooms' distance.

    Each row holds the pair (`of`, `to`), the distance of the set and of real training rooms
    (`distance_m`, `train_m`), and the share of objects within `NEAR_M` of the nearest one, in the
    set (`near`; None if it lacks the pair) and in the test rooms (`near_test`).
    """
    found, real = pair_distances(rooms, comparison), pair_distances(train, comparison)
    beyond = found.weights * (found.values_m[:, 0] - real.values_m[:, 0])
    names = label_set(comparison.train[0].label_set)
    listed = []
    for row in np.argsort(-beyond, kind="stable")[:LISTED]:
        pair = found.pairs[row]
        near, near_test = (
            float((gaps[pair].gaps_m <= NEAR_M).mean()) if pair in gaps else None
            for gaps in found.gaps
        )
        listed.append(
            {
                "of": names[pair[0]], "to": names[pair[1]],
                "distance_m": float(found.values_m[row, 0]),
                "train_m": float(real.values_m[row, 0]), "near": near, "near_test": near_test,
            }
        )  # fmt: skip
    return listed

"""Accuracy of a classifier that separates a set's layouts from real ones by relations of boxes.

It is 0.5 if the sets are indistinguishable, and 1 if every room is classified correctly. Copies of
real rooms pass as real, so read this accuracy together with `near_copy_share`.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from sceneprior.core.boxes import intersection_volumes
from sceneprior.core.classes import label_set
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import (
    AGAINST_TEST,
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
_X_AND_Z = (0, 2)


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
        to_edges = np.minimum(low - low.min(0), high.max(0) - high)[:, _X_AND_Z]
        described = np.column_stack([centers_m[:, 1], to_edges.min(1), to_edges.max(1)])
        for name in np.unique(object_class):
            single[:, name] = described[object_class == name].mean(0)
        first, second = np.triu_indices(len(object_class), k=1)
        apart = np.abs(centers_m[first] - centers_m[second])[:, _X_AND_Z]
        reach = (sizes_m[first] + sizes_m[second])[:, _X_AND_Z] / 2
        gaps = np.linalg.norm(np.maximum(apart - reach, 0), axis=1)
        shared = intersection_volumes(centers_m, sizes_m, centers_m, sizes_m)[first, second]
        volumes = sizes_m.prod(1)
        shares = shared / np.minimum(volumes[first], volumes[second])
        one, other = np.sort([object_class[first], object_class[second]], axis=0)
        for which, values, least in ((0, gaps, True), (1, shares, False), (2, apart.min(1), True)):
            # The wanted value is sorted last, because the last value written to a pair is kept.
            order = np.argsort(-values if least else values)
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
    protocol={
        "layout_classifier_accuracy": f"gradient boosting ({TREES} trees, depth 3, square root "
        f"of the features per split), noise of {JITTER_M} m; trained on all real training and "
        f"val rooms and {FOLDS - 1}/{FOLDS} of the set (at most as many rooms), evaluated on "
        "the test rooms and the rest of the set; equal total weight for real and other rooms; "
        "interval: over evaluated rooms, classifiers not retrained"
    },
    column=TableColumn(
        "layout classifier", 2,
        "layout classifier: accuracy of a classifier of boxes and their relations",
    ),
)  # fmt: skip
def layout_classifier_accuracy(rooms: RoomSet, comparison: Comparison) -> Estimate:
    from sklearn.model_selection import KFold

    scenes, counts, real = rooms.scenes, rooms.counts, comparison.real
    if any(scene is other for scene in scenes[:1] for other in real):
        # To score the real training rooms, the classifier separates two halves of the real rooms.
        order = np.random.default_rng((comparison.seed, 3)).permutation(len(real))
        halves = np.array_split(order, 2)
        scenes, real = ([real[row] for row in half] for half in halves)
        counts = resample_counts(len(scenes), len(counts), (comparison.seed, 4))
    test, seed = comparison.test, comparison.seed
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

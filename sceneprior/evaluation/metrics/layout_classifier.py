"""Can a classifier tell a set's layouts from real ones by how a room's objects relate?

It reads boxes alone. 0.5 where it cannot, 1 where it always can.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from sklearn.ensemble import GradientBoostingClassifier

from sceneprior.classes import label_set
from sceneprior.evaluation.bootstrap import Estimate
from sceneprior.evaluation.metric import AGAINST_TEST, Comparison, Metric, RoomSet, TableColumn
from sceneprior.evaluation.metrics.classifier import FOLDS, cross_validated_predictions
from sceneprior.evaluation.metrics.overlaps import intersection_volumes
from sceneprior.scene import Scene

JITTER_M = 0.07
"""Standard deviation of the noise on every centre and size of both sets, so that layouts are
compared and not millimetres: real boxes touch walls and each other exactly. Larger sees less."""
REPEATS = 3
"""Times that folds are drawn, and as many rooms of the larger set as the smaller one has."""
ABSENT = -1.0
"""The feature of classes that a room does not hold; all others but heights are 0 or more."""
_X_AND_Z = (0, 2)


def layout_features(
    centers_m: Float[np.ndarray, "objects 3"],
    sizes_m: Float[np.ndarray, "objects 3"],
    object_class: Int[np.ndarray, " objects"],
    classes: int,
) -> Float[np.ndarray, " features"]:
    """What the classifier reads of a room, in metres; quarter turns, mirror images, moving the room
    and the order of its objects change nothing.

    Per class: how many; mean height of the centres; mean distance to the nearest edge, and to the
    nearest edge along the other axis, of the rectangle round all furniture (0 in a corner: both).
    Per pair of classes, over all pairs of objects: the smallest gap between footprints; the largest
    part of the smaller box's volume that both share; the smallest misalignment, which is the
    difference of the centres along x or z, whichever is smaller.
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
            # Worst first: the value of a pair of classes that is written last stays.
            order = np.argsort(-values if least else values)
            pairs[which, one[order], other[order]] = values[order]
    upper = np.triu_indices(classes)
    return np.concatenate([counts, single.ravel(), *(part[upper] for part in pairs)])


def jittered_features(
    scenes: Sequence[Scene], seed: tuple[int, ...]
) -> Float[np.ndarray, "rooms features"]:
    """`layout_features` of rooms whose boxes have noise of `JITTER_M` on them."""
    rng = np.random.default_rng(seed)
    rows = []
    for scene in scenes:
        moved = scene.centers_m + rng.normal(0, JITTER_M, scene.centers_m.shape)
        resized = scene.sizes_m + rng.normal(0, JITTER_M, scene.sizes_m.shape)
        sizes = np.maximum(resized, JITTER_M / 2)  # a flat box, such as a rug's, stays a box
        classes = len(label_set(scene.label_set))
        rows.append(layout_features(moved, sizes, scene.class_indices, classes))
    return np.stack(rows)


def boosted_trees(
    features: Float[np.ndarray, "rooms features"],
    labels: Int[np.ndarray, " rooms"],
    others: Float[np.ndarray, "others features"],
    seed: int,
) -> Int[np.ndarray, " others"]:
    """Gradient boosting, each tree on a random few of the features."""
    varied = features.std(0) > 0  # most pairs of classes never meet
    if not varied.any():
        return np.zeros(len(others), dtype=int)
    model = GradientBoostingClassifier(max_features="sqrt", random_state=seed % 2**32)
    model.fit(features[:, varied], labels)
    return np.asarray(model.predict(others[:, varied]), dtype=int)


def _accuracy(rooms: RoomSet, comparison: Comparison) -> Estimate:
    test = comparison.test
    told = cross_validated_predictions(
        jittered_features(rooms.scenes, (comparison.seed, 0)),
        jittered_features(test.scenes, (comparison.seed, 1)),
        comparison.seed,
        boosted_trees,
        REPEATS,
    )
    return told.accuracy(rooms.counts, test.counts)


METRICS = (
    Metric(
        "layout_classifier_accuracy", "Classifier accuracy, layouts", "", "half",
        "Accuracy of a classifier of boxes (scikit-learn's gradient boosting, 100 trees, on the "
        "features of `layout_features`: counts, heights and distances to the edge by class, gaps, "
        "overlaps and misalignments by pair of classes) that tells the set from test rooms: noise "
        "of 7 cm on all centres and sizes, 5 folds, drawn 3 times, with as many rooms of the "
        "larger set as the smaller one has.",
        _accuracy, AGAINST_TEST,
        protocol={
            "layout_classifier_accuracy": "gradient boosting (100 trees, depth 3, square root "
            f"of the features a split), noise of {JITTER_M} m, {FOLDS}-fold, {REPEATS} draws of "
            "folds and of as many rooms of the larger set as the smaller one has; interval: over "
            "rooms, the classifiers as they are"
        },
        column=TableColumn(
            "layout classifier", 2,
            "layout classifier: accuracy of a classifier of boxes and their relations",
        ),
    ),
)  # fmt: skip

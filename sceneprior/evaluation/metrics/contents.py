"""Metrics of room contents: class frequencies, numbers of objects, furniture of a room type; and
objects of decoded training rooms that match the ground truth."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Int

from sceneprior.core.boxes import SceneMatch, match_scenes
from sceneprior.core.classes import LABEL_SETS, VOID, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import (
    AGAINST_TEST,
    MATCHED,
    Comparison,
    Estimate,
    RoomSet,
    TableColumn,
    mean_over_rooms,
    metric,
    object_count,
)

KL_EPSILON = 1e-6
"""Added to both frequencies inside the logarithm, as in ATISS: a class that is never generated
costs about p * log(p / 1e-6) instead of infinity."""
TYPE_CLASSES: dict[str, tuple[str, ...]] = {
    "front3d_bedroom": ("double_bed", "single_bed", "kids_bed"),
    "front3d_living": ("sofa", "armchair"),
}
"""Classes that define a room type: a room of the type holds an object of at least one of them.
ScanNet has no entry, since its scans mix room types."""


def common_label_set(*groups: Sequence[Scene]) -> str:
    """The label set that all scenes share; raises InputError if they share none."""
    names = sorted({scene.label_set for scenes in groups for scene in scenes})
    if len(names) != 1:
        came = f"label sets {', '.join(names)}" if names else "no scenes"
        raise InputError(
            f"Scores compare scenes of one label set, but {came} were given; give scenes whose "
            f"classes are those of the shards ({' or '.join(LABEL_SETS)})."
        )
    return names[0]


def class_counts(scenes: Sequence[Scene]) -> Int[np.ndarray, "scenes classes"]:
    """Number of objects of each class in each scene, void left out (column 0 is 0).

    Raises InputError like `common_label_set`.
    """
    classes = len(label_set(common_label_set(scenes)))
    table = np.stack([np.bincount(scene.class_indices, minlength=classes) for scene in scenes])
    table[:, VOID] = 0
    return table


def _shares(counts: np.ndarray) -> np.ndarray:
    return np.asarray(counts / np.maximum(counts.sum(-1, keepdims=True), 1))


def _holds_its_type(scene: Scene) -> bool | None:
    """True if a scene holds the furniture of its room type; None without a room type."""
    wanted = TYPE_CLASSES.get(scene.label_set)
    return None if wanted is None else any(item.label in wanted for item in scene.objects)


def category_kl(
    rooms: Int[np.ndarray, "rooms classes"],
    test: Int[np.ndarray, "test classes"],
    counts: Int[np.ndarray, "resamples rooms"],
    test_counts: Int[np.ndarray, "resamples test"],
) -> Estimate:
    """KL divergence of the generated rooms' class frequencies q from the test rooms' p, in nats,
    from the objects of each class.

        KL = sum_c p_c * (log(p_c + 1e-6) - log(q_c + 1e-6))  (Paschalidou et al., NeurIPS 2021)

    Both leave void out. Comparing with training rooms instead of test rooms would give values that
    are too good.
    """

    def divergence(p: np.ndarray, q: np.ndarray) -> float:
        return float((p * (np.log(p + KL_EPSILON) - np.log(q + KL_EPSILON))).sum())

    value = divergence(_shares(test.sum(0)), _shares(rooms.sum(0)))
    pairs = zip(_shares(test_counts @ test), _shares(counts @ rooms), strict=True)
    return Estimate(value, np.array([divergence(p, q) for p, q in pairs]), 0.0)


@metric(
    "category_kl", "Category KL to test rooms", "nats", "closer", AGAINST_TEST,
    protocol={"category_kl": f"KL(test || generated) in nats, epsilon {KL_EPSILON}, without void"},
    column=TableColumn("category KL", 3),
)  # fmt: skip
def _category_kl(rooms: RoomSet, comparison: Comparison) -> Estimate:
    test = comparison.test
    tables = class_counts(rooms.scenes), class_counts(test.scenes)
    return category_kl(*tables, rooms.counts, test.counts)


metric("mean_objects", "Objects in a room", "mean", "none", column=TableColumn("objects", 2))(
    mean_over_rooms(object_count)
)
metric(
    "type_share", "Rooms that hold their type's furniture", "share", "higher",
    column=TableColumn("type", 2, "type: rooms that hold the furniture their type needs"),
)(mean_over_rooms(_holds_its_type, 1.0))  # fmt: skip


def reconstruction_scores(pairs: Sequence[tuple[Scene, Scene]]) -> dict[str, float | int | None]:
    """Scores of (decoded, true) rooms: the metrics of `MATCHED` rooms by key, and the numbers of
    rooms and objects.

    Every true object has the same weight. Scores of objects are None if no room holds any.
    """
    matches = [match_scenes(decoded, truth) for decoded, truth in pairs]
    objects = sum(match.truth_count for match in matches)
    decoded = (_class_accuracy, _box_iou_3d, _count_accuracy)
    scores = {function.__name__.strip("_"): function(matches) for function in decoded}
    return {**scores, "rooms": len(pairs), "objects": objects}


def _mean_over_objects(
    matches: Sequence[SceneMatch], value: Callable[[SceneMatch], np.ndarray]
) -> float | None:
    """The mean over true objects of one value each, 0 for those without a match."""
    objects = sum(match.truth_count for match in matches)
    total = sum(float(value(match).sum()) for match in matches)
    return total / objects if objects else None


@metric(
    "class_accuracy", "Classes of decoded training rooms", "share of objects", "higher", MATCHED
)
def _class_accuracy(matches: Sequence[SceneMatch]) -> float | None:
    return _mean_over_objects(matches, lambda match: match.correct)


@metric(
    "box_iou_3d", "Box IoU of decoded training rooms", "IoU", "higher", MATCHED,
    column=TableColumn(
        "train box IoU", 2, "train box IoU: decoded training rooms against the truth"
    ),
)  # fmt: skip
def _box_iou_3d(matches: Sequence[SceneMatch]) -> float | None:
    return _mean_over_objects(matches, lambda match: match.iou)


@metric(
    "count_accuracy", "Numbers of objects of decoded training rooms", "share of rooms", "higher",
    MATCHED,
)  # fmt: skip
def _count_accuracy(matches: Sequence[SceneMatch]) -> float | None:
    same = sum(match.decoded_count == match.truth_count for match in matches)
    return same / len(matches) if matches else None

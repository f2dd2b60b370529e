"""Metrics of room contents: class frequencies, numbers of objects, furniture of a room type."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from sceneprior.core.classes import LABEL_SETS, VOID, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.evaluation.bootstrap import Estimate
from sceneprior.evaluation.metric import (
    AGAINST_TEST,
    Comparison,
    Metric,
    RoomSet,
    TableColumn,
    mean_over_rooms,
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


def class_frequencies(scenes: Sequence[Scene]) -> Float[np.ndarray, "classes"]:
    """Share of each class among all objects of all scenes, void left out; 0 without objects."""
    return np.asarray(_shares(class_counts(scenes).sum(0)))


def _shares(counts: np.ndarray) -> np.ndarray:
    return np.asarray(counts / np.maximum(counts.sum(-1, keepdims=True), 1))


def category_kl(p: Float[np.ndarray, " classes"], q: Float[np.ndarray, " classes"]) -> float:
    """KL divergence of the generated rooms' class frequencies q from the test rooms' p, in nats.

        KL = sum_c p_c * (log(p_c + 1e-6) - log(q_c + 1e-6))  (Paschalidou et al., NeurIPS 2021)

    Both leave void out. Comparing with training rooms instead of test rooms would give values that
    are too good.
    """
    return float((p * (np.log(p + KL_EPSILON) - np.log(q + KL_EPSILON))).sum())


def object_counts(scenes: Sequence[Scene]) -> Int[np.ndarray, "scenes"]:
    """Number of objects in each scene, void left out."""
    return np.array([_count(scene) for scene in scenes], dtype=np.int64)


def _count(scene: Scene) -> int:
    return int((scene.class_indices != VOID).sum())


def emptiness(scenes: Sequence[Scene]) -> str | None:
    """A warning if more than half of the generated rooms are empty; else None.

    Metrics of empty rooms mislead: no objects intersect, and a blank picture easily lies in the
    ball around a real room's picture, which raises precision.
    """
    empty = int((object_counts(scenes) == 0).sum())
    if 2 * empty <= len(scenes):
        return None
    return (
        f"{empty} of {len(scenes)} generated rooms are empty, so none of the other scores can be "
        "trusted: train longer."
    )


def type_share(scenes: Sequence[Scene]) -> float | None:
    """Share of the scenes that hold the furniture of their room type (`TYPE_CLASSES`).

    None for a label set without a room type, and if there are no scenes.
    """
    known = [holds for scene in scenes if (holds := _holds_its_type(scene)) is not None]
    return float(np.mean(known)) if known else None


def _holds_its_type(scene: Scene) -> bool | None:
    wanted = TYPE_CLASSES.get(scene.label_set)
    return None if wanted is None else any(item.label in wanted for item in scene.objects)


def category_kl_of_counts(
    rooms: Int[np.ndarray, "rooms classes"],
    test: Int[np.ndarray, "test classes"],
    counts: Int[np.ndarray, "resamples rooms"],
    test_counts: Int[np.ndarray, "resamples test"],
) -> Estimate:
    """`category_kl` from the objects of each class, with its value on every resample."""
    pairs = zip(_shares(test_counts @ test), _shares(counts @ rooms), strict=True)
    value = category_kl(_shares(test.sum(0)), _shares(rooms.sum(0)))
    return Estimate(value, np.array([category_kl(p, q) for p, q in pairs]), 0.0)


def _category_kl(rooms: RoomSet, comparison: Comparison) -> Estimate:
    test = comparison.test
    tables = class_counts(rooms.scenes), class_counts(test.scenes)
    return category_kl_of_counts(*tables, rooms.counts, test.counts)


METRICS = (
    Metric(
        "category_kl", "Category KL to test rooms", "nats", "closer", _category_kl, AGAINST_TEST,
        protocol={
            "category_kl": f"KL(test || generated) in nats, epsilon {KL_EPSILON}, without void"
        },
        column=TableColumn("category KL", 3),
    ),
    Metric(
        "mean_objects", "Objects in a room", "mean", "none", mean_over_rooms(_count),
        column=TableColumn("objects", 2),
    ),
    Metric(
        "type_share", "Rooms that hold their type's furniture", "share", "higher",
        mean_over_rooms(_holds_its_type, 1.0),
        column=TableColumn("type", 2, "type: rooms that hold the furniture their type needs"),
    ),
)  # fmt: skip

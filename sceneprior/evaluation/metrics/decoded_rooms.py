"""Decoded training rooms against their ground truth: pairs of objects, their IoU and classes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sceneprior.evaluation.metric import Metric, TableColumn
from sceneprior.evaluation.metrics.contents import common_label_set
from sceneprior.evaluation.metrics.overlaps import intersection_volumes
from sceneprior.scene import Scene

CENTER_WEIGHT = 0.01
"""Matching cost per metre between centres: decides between boxes that do not overlap, and stays
far below what a change of IoU costs."""


def box_iou_3d(
    centers_a: Float[np.ndarray, "n 3"],
    sizes_a: Float[np.ndarray, "n 3"],
    centers_b: Float[np.ndarray, "m 3"],
    sizes_b: Float[np.ndarray, "m 3"],
) -> Float[np.ndarray, "n m"]:
    """Intersection over union of every axis-aligned box a with every box b, in metres.

    Two boxes without volume have IoU 0.

    Example: two unit cubes that share one half.

        >>> unit = np.ones((1, 3))
        >>> iou = box_iou_3d(np.zeros((1, 3)), unit, np.array([[0.5, 0.0, 0.0]]), unit)
        >>> round(float(iou[0, 0]), 6)
        0.333333
    """
    shared = intersection_volumes(centers_a, sizes_a, centers_b, sizes_b)
    union = sizes_a.prod(1)[:, None] + sizes_b.prod(1)[None] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


@dataclass(frozen=True)
class SceneMatch:
    """Which decoded object stands for which true one, decided by boxes alone."""

    decoded: Int[np.ndarray, " pairs"]
    """Rows of the decoded scene."""
    truth: Int[np.ndarray, " pairs"]
    """Rows of the true scene."""
    iou: Float[np.ndarray, " pairs"]
    correct: Bool[np.ndarray, " pairs"]
    """Whether the classes agree."""
    decoded_count: int
    truth_count: int
    """Objects of the scenes, matched or not."""

    @property
    def class_accuracy(self) -> float | None:
        return _class_accuracy([self])

    @property
    def mean_iou(self) -> float | None:
        return _mean_iou([self])


def _class_accuracy(matches: Sequence[SceneMatch]) -> float | None:
    return _over_objects([float(match.correct.sum()) for match in matches], matches)


def _mean_iou(matches: Sequence[SceneMatch]) -> float | None:
    return _over_objects([float(match.iou.sum()) for match in matches], matches)


def _over_objects(of_rooms: Sequence[float], matches: Sequence[SceneMatch]) -> float | None:
    objects = sum(match.truth_count for match in matches)
    return sum(of_rooms) / objects if objects else None


def _count_accuracy(matches: Sequence[SceneMatch]) -> float | None:
    same = sum(match.decoded_count == match.truth_count for match in matches)
    return same / len(matches) if matches else None


def match_scenes(decoded: Scene, truth: Scene) -> SceneMatch:
    """Pair the objects of two scenes one to one, at the least total cost.

        cost = 1 - IoU + 0.01 * (distance of the centres in metres)

    The class takes no part, so that class accuracy is not measured on pairs chosen for it.

    Raises:
        InputError: the scenes use different label sets.
    """
    from scipy.optimize import linear_sum_assignment

    common_label_set([decoded, truth])
    iou = box_iou_3d(decoded.centers_m, decoded.sizes_m, truth.centers_m, truth.sizes_m)
    apart = np.linalg.norm(decoded.centers_m[:, None] - truth.centers_m[None], axis=2)
    rows, columns = linear_sum_assignment(1 - iou + CENTER_WEIGHT * apart)
    return SceneMatch(
        decoded=rows,
        truth=columns,
        iou=iou[rows, columns],
        correct=decoded.class_indices[rows] == truth.class_indices[columns],
        decoded_count=len(decoded.objects),
        truth_count=len(truth.objects),
    )


def reconstruction_scores(pairs: Sequence[tuple[Scene, Scene]]) -> dict[str, float | int | None]:
    """Scores of (decoded, true) rooms by key of `METRICS`, every true object of the same weight.

    None where no room holds an object. With the numbers of rooms and objects.
    """
    matches = [match_scenes(decoded, truth) for decoded, truth in pairs]
    objects = sum(match.truth_count for match in matches)
    scores = {metric.key: metric.function(matches) for metric in METRICS}
    return {**scores, "rooms": len(pairs), "objects": objects}


METRICS = (
    Metric(
        "class_accuracy", "Classes of decoded training rooms", "share of objects", "higher",
        "Share of true objects whose partner has the right class; an object without a partner is "
        "wrong.",
        _class_accuracy, (),
    ),
    Metric(
        "box_iou_3d", "Box IoU of decoded training rooms", "IoU", "higher",
        "Mean IoU of axis-aligned 3D boxes over true objects; an object without a partner counts "
        "0.",
        _mean_iou, (),
        column=TableColumn(
            "train box IoU", 2, "train box IoU: decoded training rooms against the truth"
        ),
    ),
    Metric(
        "count_accuracy", "Numbers of objects of decoded training rooms", "share of rooms",
        "higher", "Share of rooms with the right number of objects.", _count_accuracy, (),
    ),
)  # fmt: skip
"""Of decoded training rooms: their functions take the matches of the rooms."""

"""Decoded training rooms against their ground truth: matched objects, their IoU and classes."""

from collections.abc import Sequence
from functools import partial

from sceneprior.core.overlaps import SceneMatch, match_scenes
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import Metric, TableColumn


def _mean_over_objects(value: str, matches: Sequence[SceneMatch]) -> float | None:
    """The mean of an attribute of `SceneMatch` over true objects, 0 for those without a match."""
    objects = sum(match.truth_count for match in matches)
    total = sum(float(getattr(match, value).sum()) for match in matches)
    return total / objects if objects else None


def _count_accuracy(matches: Sequence[SceneMatch]) -> float | None:
    same = sum(match.decoded_count == match.truth_count for match in matches)
    return same / len(matches) if matches else None


def reconstruction_scores(pairs: Sequence[tuple[Scene, Scene]]) -> dict[str, float | int | None]:
    """Scores of (decoded, true) rooms by key of `METRICS`, and the numbers of rooms and objects.

    Every true object has the same weight. Scores of objects are None if no room holds any.
    """
    matches = [match_scenes(decoded, truth) for decoded, truth in pairs]
    objects = sum(match.truth_count for match in matches)
    scores = {metric.key: metric.function(matches) for metric in METRICS}
    return {**scores, "rooms": len(pairs), "objects": objects}


METRICS = (
    Metric(
        "class_accuracy", "Classes of decoded training rooms", "share of objects", "higher",
        partial(_mean_over_objects, "correct"), (),
    ),
    Metric(
        "box_iou_3d", "Box IoU of decoded training rooms", "IoU", "higher",
        partial(_mean_over_objects, "iou"), (),
        column=TableColumn(
            "train box IoU", 2, "train box IoU: decoded training rooms against the truth"
        ),
    ),
    Metric(
        "count_accuracy", "Numbers of objects of decoded training rooms", "share of rooms",
        "higher", _count_accuracy, (),
    ),
)  # fmt: skip
"""Metrics of decoded training rooms; their functions take the rooms' `SceneMatch`es."""

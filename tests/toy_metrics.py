"""Helpers for tests of metrics: torchmetrics' side of a comparison, and rooms of unit boxes."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from sceneprior.core.classes import label_set
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.evaluation.metric import Comparison, RoomSet, resample_counts
from sceneprior.evaluation.metrics import layouts, picture_classifiers

UNIT = (1.0, 1.0, 1.0)


class Plain(torch.nn.Module):
    """A feature network whose features are its inputs, as torchmetrics wants one."""

    num_features = 12

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        return rows[:, :, 0, 0].double()


def fed(metric, a: np.ndarray, b: np.ndarray):
    for rows, real in ((b, True), (a, False)):
        metric.update(torch.from_numpy(rows)[:, :, None, None].expand(-1, -1, 3, 3), real=real)
    return metric.compute()


def room(*items: tuple[str, tuple[float, float, float]], sizes=None) -> Scene:
    sizes = sizes or [UNIT] * len(items)
    objects = [
        SceneObject(label, tuple(map(float, at)), tuple(map(float, size)))
        for (label, at), size in zip(items, sizes, strict=True)
    ]
    return Scene("room", "front3d_bedroom", tuple(objects))


def of_classes(*labels: str) -> Scene:
    return room(*((label, (3.0 * index, 0.5, 0.0)) for index, label in enumerate(labels)))


def room_set(scenes: Sequence[Scene]) -> RoomSet:
    """A set without pictures."""
    return RoomSet(scenes, {}, resample_counts(len(scenes), 20, 0))


def without_classifiers(patch: pytest.MonkeyPatch) -> None:
    """Replace the classifiers, which take most of the time of an evaluation, in tests of other
    things."""

    def answer_one(features, labels, others, seed):
        return np.ones(len(others), dtype=int)

    patch.setattr(picture_classifiers, "linear", answer_one)
    patch.setattr(layouts, "boosted_trees", answer_one)


def compared_with(test: RoomSet, **known) -> Comparison:
    """A comparison with these test rooms; `known` is what the metric under test needs."""
    classes = len(label_set("front3d_bedroom"))
    plausible = np.zeros((classes, classes), dtype=bool)
    given = {"train": [], "val": [], "decoded": []} | known
    given = {"plausible_pairs": plausible, "near_copy_m": 0.0} | given
    return Comparison(test=test, seed=0, alexnet=None, **given)

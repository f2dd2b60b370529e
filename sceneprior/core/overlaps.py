"""Overlaps of axis-aligned 3D boxes, and one-to-one matching of the objects of two scenes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene

CENTER_WEIGHT = 0.01
"""Matching cost per metre between centres. It decides between boxes that do not overlap, and is
negligible against differences in IoU."""


def intersection_volumes(
    centers_a: Float[np.ndarray, "n 3"],
    sizes_a: Float[np.ndarray, "n 3"],
    centers_b: Float[np.ndarray, "m 3"],
    sizes_b: Float[np.ndarray, "m 3"],
) -> Float[np.ndarray, "n m"]:
    """Intersection volume of every axis-aligned box a with every box b, in cubic metres."""
    low = np.maximum((centers_a - sizes_a / 2)[:, None], (centers_b - sizes_b / 2)[None])
    high = np.minimum((centers_a + sizes_a / 2)[:, None], (centers_b + sizes_b / 2)[None])
    return np.asarray(np.clip(high - low, 0, None).prod(2))


def shared_of_smaller(a: Scene, b: Scene) -> Float[np.ndarray, "n m"]:
    """Intersection of each box of a with each box of b, as a share of the smaller box, in [0, 1].

    The share is 0 if one of the two boxes has no volume.
    """
    shared = intersection_volumes(a.centers_m, a.sizes_m, b.centers_m, b.sizes_m)
    smaller = np.minimum(a.sizes_m.prod(1)[:, None], b.sizes_m.prod(1)[None])
    return np.divide(shared, smaller, out=np.zeros_like(shared), where=smaller > 0)


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
    """Matches between decoded and true objects, determined by their boxes alone."""

    decoded: Int[np.ndarray, " pairs"]
    """Indices of objects in the decoded scene."""
    truth: Int[np.ndarray, " pairs"]
    """Indices of objects in the true scene."""
    iou: Float[np.ndarray, " pairs"]
    correct: Bool[np.ndarray, " pairs"]
    """True if the classes agree."""
    decoded_count: int
    truth_count: int
    """Number of true objects; like `decoded_count`, it includes unmatched objects."""

    @property
    def class_accuracy(self) -> float | None:
        """Share of the true objects whose match has the correct class; None without objects."""
        return float(self.correct.sum()) / self.truth_count if self.truth_count else None

    @property
    def mean_iou(self) -> float | None:
        """Mean box IoU over the true objects; None without objects."""
        return float(self.iou.sum()) / self.truth_count if self.truth_count else None


def match_scenes(decoded: Scene, truth: Scene) -> SceneMatch:
    """Match the objects of two scenes one to one, with the least total cost.

        cost = 1 - IoU + 0.01 * (distance of the centres in metres)

    Classes are ignored, so that class accuracy is not measured on pairs chosen by class.
    """
    from scipy.optimize import linear_sum_assignment

    if decoded.label_set != truth.label_set:
        raise InputError(
            f"Objects are paired between scenes of one label set, but {decoded.name} has "
            f"'{decoded.label_set}' and {truth.name} '{truth.label_set}'; bring both into one."
        )
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

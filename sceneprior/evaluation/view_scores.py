"""Scores of reconstructions from single images, from pairs of a true and a found object."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneprior.errors import InputError
from sceneprior.evaluation.metrics.decoded_rooms import box_iou_3d
from sceneprior.evaluation.metrics.mesh_metrics import (
    F_THRESHOLD_M,
    POINTS,
    f_score,
    oriented_box,
    oriented_box_iou_3d,
    sample_surface,
)
from sceneprior.evaluation.topdown import object_mesh
from sceneprior.geometry.surfaces import chamfer_sum
from sceneprior.scene import SceneObject


@dataclass(frozen=True)
class ObjectPair:
    """A true object that an image shows, and what was found for its mask."""

    truth: SceneObject
    found: SceneObject | None
    """None where nothing was: its IoUs and F-score are 0, and it has no distance."""


@dataclass(frozen=True)
class PairScore:
    """How well one true object was found."""

    label: str
    box_iou_3d: float
    oriented_box_iou_3d: float
    chamfer_l2_m: float | None
    chamfer_squared_m2: float | None
    f_score: float
    class_right: bool


def score_pair(pair: ObjectPair, points: int = POINTS, seed: int = 0) -> PairScore:
    """Compare two objects where they stand (`object_mesh`).

    `points` are drawn from each surface, uniformly by area, different ones by the same seed.
    """
    truth, found = pair.truth, pair.found
    if found is None:
        return PairScore(truth.label, 0.0, 0.0, None, None, 0.0, False)
    surfaces = [object_mesh(truth), object_mesh(found)]
    a, b = (sample_surface(mesh, points, 2 * seed + i) for i, mesh in enumerate(surfaces))
    distance = chamfer_sum(a, b)
    boxes = (
        np.array([part], dtype=np.float64)
        for item in (truth, found)
        for part in (item.center_m, item.size_m)
    )
    return PairScore(
        label=truth.label,
        box_iou_3d=float(box_iou_3d(*boxes)[0, 0]),
        oriented_box_iou_3d=oriented_box_iou_3d(*map(oriented_box, surfaces)),
        chamfer_l2_m=distance.l2_m,
        chamfer_squared_m2=distance.squared_m2,
        f_score=f_score(a, b, F_THRESHOLD_M),
        class_right=found.label == truth.label,
    )


def score_views(
    views: Sequence[Sequence[ObjectPair]], points: int = POINTS, seed: int = 0
) -> dict[str, Any]:
    """Scores of single-view reconstructions, every true object with the same weight.

    `summary` is of all objects of all images, `classes` the same of each true class. No object at
    all is an InputError.
    """
    scores = [
        score_pair(pair, points, seed + row)
        for row, pair in enumerate(pair for view in views for pair in view)
    ]
    if not scores:
        raise InputError("No image shows an object, so there is nothing to score.")
    labels = sorted({score.label for score in scores})
    by_class = {name: [score for score in scores if score.label == name] for name in labels}
    return {
        "summary": {"images": len(views), **summary(scores)},
        "classes": {name: summary(some) for name, some in by_class.items()},
    }


def summary(scores: Sequence[PairScore]) -> dict[str, float | int | None]:
    """Means over objects; the distances over those for which something was found, else None."""

    def mean(name: str) -> float | None:
        known = [value for score in scores if (value := getattr(score, name)) is not None]
        return sum(known) / len(known) if known else None

    return {
        "objects": len(scores),
        "unmatched": sum(score.chamfer_l2_m is None for score in scores),
        **{name: mean(name) for name in PROTOCOL if name != "objects"},
        "class_accuracy": mean("class_right"),
    }


PROTOCOL = {
    "objects": "those that the image shows, each matched to what was found for its mask by the "
    "fit's own assignment (class and 2D box); every object weighs the same",
    "box_iou_3d": "axis-aligned boxes in the room frame",
    "oriented_box_iou_3d": "upright boxes around the meshes, over the footprint's rectangle of "
    "least area",
    "chamfer_l2_m": "mean distance to the nearest point of the other surface, both ways added, in "
    "metres",
    "chamfer_squared_m2": "the same of squared distances, in square metres",
    "f_score": f"at {F_THRESHOLD_M} m",
}
"""What the metrics are, as it stands in result files."""

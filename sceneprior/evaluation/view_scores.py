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
from sceneprior.geometry.surfaces import chamfer_sum
from sceneprior.scene import SceneObject
from sceneprior.topdown import object_mesh


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
    found: bool
    surface_known: bool
    """Whether the true surface is; all but the boxes and the class is compared with it."""
    class_right: bool
    box_iou_3d: float
    oriented_box_iou_3d: float | None = None
    chamfer_l2_m: float | None = None
    chamfer_squared_m2: float | None = None
    f_score: float | None = None


def score_pair(pair: ObjectPair, points: int = POINTS, seed: int = 0) -> PairScore:
    """Compare two objects where they stand; a found one without a mesh by its box.

    `points` are drawn from each surface, uniformly by area, different ones by the same seed.
    """
    truth, found = pair.truth, pair.found
    known = truth.mesh is not None
    if found is None:
        worst = 0.0 if known else None
        return PairScore(truth.label, False, known, False, 0.0, worst, f_score=worst)
    boxes = (
        np.array([part], dtype=np.float64)
        for item in (truth, found)
        for part in (item.center_m, item.size_m)
    )
    box_iou, class_right = float(box_iou_3d(*boxes)[0, 0]), found.label == truth.label
    if truth.mesh is None:  # a right shape would be punished for not being a box
        return PairScore(truth.label, True, False, class_right, box_iou)
    surfaces = [truth.mesh, object_mesh(found)]
    a, b = (sample_surface(mesh, points, 2 * seed + i) for i, mesh in enumerate(surfaces))
    distance = chamfer_sum(a, b)
    return PairScore(
        label=truth.label,
        found=True,
        surface_known=True,
        class_right=class_right,
        box_iou_3d=box_iou,
        oriented_box_iou_3d=oriented_box_iou_3d(*map(oriented_box, surfaces)),
        chamfer_l2_m=distance.l2_m,
        chamfer_squared_m2=distance.squared_m2,
        f_score=f_score(a, b, F_THRESHOLD_M),
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
    """Means over the objects that have a figure, and on how many those of surfaces stand."""

    def mean(name: str) -> float | None:
        known = [value for score in scores if (value := getattr(score, name)) is not None]
        return sum(known) / len(known) if known else None

    return {
        "objects": len(scores),
        "unmatched": sum(not score.found for score in scores),
        "with_surface": sum(score.surface_known for score in scores),
        **{name: mean(name) for name in METRICS},
        "class_accuracy": mean("class_right"),
    }


def surface_note(objects: int, with_surface: int, shards: str) -> str | None:
    """Why metrics of surfaces stand on fewer objects than those of boxes; None if they do not."""
    if with_surface == objects:
        return None
    short = f"only of the {with_surface} that do" if with_surface else "not at all"
    return (
        f"{objects - with_surface} of {objects} true objects have a box but no surface, and a "
        f"right shape would be punished for not being a box: Chamfer distance, F-score and "
        f"oriented IoU are reported {short}. ScanNet's surfaces come with shards that `sceneprior "
        f"prep-scannet` makes today; {shards} may be older."
    )


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
"""What is compared and the metrics, as it stands in result files."""
METRICS = tuple(name for name in PROTOCOL if name != "objects")

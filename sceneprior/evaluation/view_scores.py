"""Scores of single-view reconstructions, computed from pairs of a true and a fitted object: Chamfer
distance, F-score and box IoU."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import shapely
import trimesh
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, StrictInt

from sceneprior.core.boxes import box_iou_3d
from sceneprior.core.errors import InputError
from sceneprior.core.parallel import map_blocks
from sceneprior.core.scene import Mesh, SceneObject
from sceneprior.core.surfaces import chamfer_of, nearest_distances
from sceneprior.evaluation.metric import COVERAGE, ratio, resample_counts
from sceneprior.evaluation.score_table import Number
from sceneprior.render.appearance import object_mesh

POINTS = 10_000
"""Points sampled per surface. Two samples of one sphere of radius 1 m still have a Chamfer distance
(`ChamferSum.l2_m`) of 35 mm; with 1,000 points, 112 mm."""
F_THRESHOLD_M = 0.05
"""Distance to the other surface up to which a point counts as correct for the F-score."""


class _Summary(BaseModel):
    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Number | None]
    objects: StrictInt
    with_surface: StrictInt
    images: StrictInt
    rooms: StrictInt


class _ViewsRow(BaseModel):
    summary: _Summary
    intervals: dict[str, tuple[Number, Number] | None]


class _ViewsRows(BaseModel):
    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, _ViewsRow]
    fit: _ViewsRow
    nearest_room: _ViewsRow
    random_room: _ViewsRow


class _ViewsProtocol(BaseModel):
    shards: str
    known_model_share: Number | None


class ViewScores(BaseModel):
    """The contents of a result file of `eval-svr`."""

    rows: _ViewsRows
    cpu_seconds_an_image: Number
    protocol: _ViewsProtocol


def sample_surface(mesh: Mesh, count: int, seed: int) -> Float[np.ndarray, "count 3"]:
    """Draw points uniformly by area from a mesh's surface, inner faces included.

    If no face has an area, all points lie on the first face.
    """
    if not len(mesh.faces):
        raise InputError(
            "A mesh without faces has no surface to draw points from; give the object a mesh with "
            "faces, or no mesh at all: then its box is used."
        )
    surface = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    points = trimesh.sample.sample_surface(surface, count, seed=seed)[0]
    return np.asarray(points, dtype=np.float64)


def f_score(
    there_m: Float[np.ndarray, " n"],
    back_m: Float[np.ndarray, " m"],
    threshold_m: float = F_THRESHOLD_M,
) -> float:
    """Harmonic mean of precision and recall, in [0, 1].

    Args:
        there_m: Distance of each point of surface a to surface b, for precision.
        back_m: Distance of each point of surface b to surface a, for recall.
        threshold_m: Distance up to which a point counts as correct.
    """
    precision, recall = (float((way <= threshold_m).mean()) for way in (there_m, back_m))
    return 2 * precision * recall / max(precision + recall, 1e-12)


def upright_box_iou_3d(a: Mesh, b: Mesh) -> float:
    """Intersection over union of the tightest upright boxes around two meshes, each over the
    footprint's rectangle of least area; 0 for boxes without volume.

    Example: a cube and the same cube turned by 45 degrees share a regular octagon.

        >>> from sceneprior.core.boxes import yaw_rotation
        >>> from sceneprior.render.appearance import box_mesh
        >>> cube = box_mesh((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        >>> turned = Mesh(cube.vertices_m @ yaw_rotation(np.pi / 4), cube.faces)
        >>> round(upright_box_iou_3d(cube, turned), 6)
        0.707107
    """
    points = [np.asarray(mesh.vertices_m, dtype=np.float64) for mesh in (a, b)]
    plans = [shapely.MultiPoint(each[:, ::2]).minimum_rotated_rectangle for each in points]
    lows, highs = np.array([(each[:, 1].min(), each[:, 1].max()) for each in points]).T
    heights = highs - lows
    shared = shapely.intersection(*plans).area * max(min(highs) - max(lows), 0.0)
    union = plans[0].area * heights[0] + plans[1].area * heights[1] - shared
    return float(shared / union) if union > 0 else 0.0


BLOCK = 64
"""Pairs of objects that a task compares."""
RESAMPLES = 1000
"""Number of bootstrap resamples of rooms per interval."""
ObjectPair = tuple[SceneObject, SceneObject | None]
"""A true object visible in an image, and the object fitted to its mask. If that is None, the true
object has IoUs and F-score 0, and no distance."""
PairScore = dict[str, Any]
"""Scores of one true object by name of `FIELDS`, its `label`, and whether it was `found` and has a
`surface`. A score is None if it is unknown."""


def score_pair(pair: ObjectPair, points: int, seed: int = 0) -> PairScore:
    """Compare two objects in the room frame; a fitted object without a mesh is its box. A true
    object without a mesh is compared by its box and class alone: compared with a box, a correct
    shape would score worse than a box.

    `points` are sampled from each surface, uniformly by area, with a different seed per surface.
    """
    truth, found = pair
    known = truth.mesh is not None
    worst = 0.0 if known else None
    score: PairScore = dict.fromkeys(FIELDS) | {
        "label": truth.label, "found": found is not None, "surface": known, "class_accuracy": False,
        "box_iou_3d": 0.0, "oriented_box_iou_3d": worst, "f_score": worst,
    }  # fmt: skip
    if found is None:
        return score
    boxes = (np.array([part]) for o in (truth, found) for part in (o.center_m, o.size_m))
    score["box_iou_3d"] = float(box_iou_3d(*boxes)[0, 0])
    score["class_accuracy"] = found.label == truth.label
    if truth.mesh is None:
        return score
    surfaces = [truth.mesh, object_mesh(found)]
    a, b = (sample_surface(mesh, points, 2 * seed + i) for i, mesh in enumerate(surfaces))
    apart_m = nearest_distances(a, b)
    distance = chamfer_of(*apart_m)
    return score | {
        "oriented_box_iou_3d": upright_box_iou_3d(*surfaces),
        "chamfer_l2_m": distance.l2_m,
        "chamfer_squared_m2": distance.squared_m2,
        "f_score": f_score(*apart_m),
    }


def _score_pairs(points: int, pairs: Sequence[ObjectPair], first: int) -> list[PairScore]:
    return [score_pair(pair, points, row) for row, pair in enumerate(pairs, first)]


def score_views(
    views: Sequence[Sequence[ObjectPair]], rooms: Sequence[str], points: int = POINTS
) -> dict[str, Any]:
    """Scores of single-view reconstructions; every true object has the same weight.

    `summary` covers all objects of all images, `intervals` holds bootstrap intervals of its
    metrics, and `classes` holds one summary per true class. `rooms` names the room of each view:
    views of one room are not independent, so a room is resampled with all objects of all its views.
    The resamples depend only on the rooms, so that several methods share them.
    """
    pairs = [pair for view in views for pair in view]
    if not pairs:
        raise InputError("No image shows an object, so there is nothing to score.")
    scores = map_blocks(partial(_score_pairs, points), pairs, BLOCK, "scoring objects")
    by_class = {label: [score for score in scores if score["label"] == label]
                for label in sorted({score["label"] for score in scores})}  # fmt: skip
    of_room = [room for room, view in zip(rooms, views, strict=True) for _ in view]
    names, number = np.unique(of_room, return_inverse=True)
    counts = resample_counts(len(names), RESAMPLES, 0)
    intervals = {}
    for name in FIELDS:
        values = [score[name] for score in scores]
        known = np.bincount(number, [value is not None for value in values])
        sums = np.bincount(number, [value or 0.0 for value in values])
        high = np.inf if name.startswith("chamfer") else 1.0
        intervals[name] = ratio(sums, known, counts, high).interval()
    return {
        "summary": {"rooms": len(set(rooms)), "images": len(views), **_summary(scores)},
        "intervals": intervals,
        "classes": {label: _summary(some) for label, some in by_class.items()},
    }


def _summary(scores: Sequence[PairScore]) -> dict[str, float | int | None]:
    """Means over the objects that have a value, and the numbers of objects behind them."""
    known = {name: [score[name] for score in scores if score[name] is not None] for name in FIELDS}
    return {
        "objects": len(scores),
        "unmatched": sum(not score["found"] for score in scores),
        "with_surface": sum(score["surface"] for score in scores),
        **{name: sum(some) / len(some) if some else None for name, some in known.items()},
    }


def surface_note(objects: int, with_surface: int, shards: str) -> str | None:
    """A note that surface metrics cover fewer objects than box metrics; None if they do not."""
    if with_surface == objects:
        return None
    short = f"only for the other {with_surface}" if with_surface else "for none"
    return (
        f"{objects - with_surface} of {objects} true objects have a box but no surface. A correct "
        f"shape scores worse against a box than a box does, so Chamfer distance, F-score and "
        f"oriented IoU are reported {short}. Shards made by today's `sceneprior prep-scannet` have "
        f"ScanNet's surfaces; {shards} may be older."
    )


FIELDS = (
    "box_iou_3d", "oriented_box_iou_3d", "chamfer_l2_m", "chamfer_squared_m2", "f_score",
    "class_accuracy",
)  # fmt: skip
"""Metrics of a summary, each a mean over objects."""
PROTOCOL = {
    "objects": "objects that the image shows, each matched to the object fitted to its mask by the "
    "fit's own assignment (class and 2D box); every object has the same weight",
    "box_iou_3d": "axis-aligned boxes in the room frame",
    "oriented_box_iou_3d": "upright boxes around the meshes, over the footprint's rectangle of "
    "least area",
    "chamfer_l2_m": "mean distance to the nearest point of the other surface, both ways added, in "
    "metres",
    "chamfer_squared_m2": "like chamfer_l2_m with squared distances, in square metres",
    "f_score": f"at {F_THRESHOLD_M} m",
    "intervals": f"{COVERAGE:.0%} bootstrap over rooms, {RESAMPLES:,} draws with replacement, all "
    "views of a room together",
}
"""The compared objects and the metrics, as described in result files."""

"""Scores of single-view reconstructions, computed from pairs of a true and a fitted object: Chamfer
distance, F-score and box IoU."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import shapely
import trimesh
from jaxtyping import Float

from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.errors import InputError
from sceneprior.core.overlaps import box_iou_3d
from sceneprior.core.scene import Mesh, SceneObject
from sceneprior.core.surfaces import chamfer_of, nearest_distances
from sceneprior.evaluation.metric import COVERAGE, ratio, resample_counts
from sceneprior.render.appearance import object_mesh

POINTS = 10_000
"""Points sampled per surface. Two samples of one sphere of radius 1 m still have a Chamfer distance
(`ChamferSum.l2_m`) of 35 mm; with 1,000 points, 112 mm."""
F_THRESHOLD_M = 0.05
"""Distance to the other surface up to which a point counts as correct for the F-score."""


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


class OrientedBox(NamedTuple):
    """An upright box, rotated about the vertical axis."""

    center_m: Float[np.ndarray, "3"]
    size_m: Float[np.ndarray, "3"]
    """Full extents along the box's own x, y and z."""
    yaw_rad: float
    """Rotation that turns +z towards +x (docs/conventions.md)."""


def oriented_box(mesh: Mesh) -> OrientedBox:
    """The tightest upright box around a mesh, over the footprint's rectangle of least area.

    The yaw is in [0, pi / 2): the front of a mesh is unknown, and the IoU does not depend on it.
    For a mesh that is an upright box, the result is that box.
    """
    points = np.asarray(mesh.vertices_m, dtype=np.float64)
    rectangle = shapely.MultiPoint(points[:, [0, 2]]).minimum_rotated_rectangle
    yaw = 0.0  # any yaw fits a footprint without area
    if isinstance(rectangle, shapely.Polygon):
        x, z = np.diff(np.asarray(rectangle.exterior.coords)[:2], axis=0)[0]
        yaw = float(np.arctan2(x, z) % (np.pi / 2))
    turn = yaw_rotation(yaw)
    own = points @ turn  # columns of `turn` are the box's axes
    low, high = own.min(axis=0), own.max(axis=0)
    return OrientedBox(turn @ (low + high) / 2, high - low, yaw)


def oriented_box_iou_3d(a: OrientedBox, b: OrientedBox) -> float:
    """Intersection over union of two upright boxes: shared footprint x shared height.

    Two boxes without volume have IoU 0. At yaw 0 it equals `box_iou_3d`.

    Example: a cube and the same cube turned by 45 degrees share a regular octagon.

        >>> cube = OrientedBox(np.zeros(3), np.ones(3), 0.0)
        >>> round(oriented_box_iou_3d(cube, cube._replace(yaw_rad=np.pi / 4)), 6)
        0.707107
    """
    low, high = ([box.center_m[1] + side * box.size_m[1] / 2 for box in (a, b)] for side in (-1, 1))
    height = max(min(high) - max(low), 0.0)
    shared = shapely.intersection(_footprint(a), _footprint(b)).area * height
    union = a.size_m.prod() + b.size_m.prod() - shared
    return float(shared / union) if union > 0 else 0.0


def _footprint(box: OrientedBox) -> shapely.Polygon:
    corners = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) / 2
    room = (corners * box.size_m) @ yaw_rotation(box.yaw_rad).T + box.center_m
    return shapely.Polygon(room[:, [0, 2]])


RESAMPLES = 1000
"""Number of bootstrap resamples of rooms per interval."""


@dataclass(frozen=True)
class ObjectPair:
    """A true object visible in an image, and the object fitted to its mask."""

    truth: SceneObject
    found: SceneObject | None
    """The fitted object. If it is None, the true object has IoUs and F-score 0, and no distance."""


@dataclass(frozen=True)
class PairScore:
    """Scores of one true object."""

    label: str
    found: bool
    surface_known: bool
    """True if the true object has a mesh; without one, only its box and class are scored."""
    class_right: bool
    box_iou_3d: float
    oriented_box_iou_3d: float | None = None
    chamfer_l2_m: float | None = None
    chamfer_squared_m2: float | None = None
    f_score: float | None = None


def score_pair(pair: ObjectPair, points: int = POINTS, seed: int = 0) -> PairScore:
    """Compare two objects in the room frame; a fitted object without a mesh is its box.

    `points` are sampled from each surface, uniformly by area, with a different seed per surface.
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
    if truth.mesh is None:  # compared with a box, a correct shape would score worse than a box
        return PairScore(truth.label, True, False, class_right, box_iou)
    surfaces = [truth.mesh, object_mesh(found)]
    a, b = (sample_surface(mesh, points, 2 * seed + i) for i, mesh in enumerate(surfaces))
    apart_m = nearest_distances(a, b)
    distance = chamfer_of(*apart_m)
    return PairScore(
        label=truth.label,
        found=True,
        surface_known=True,
        class_right=class_right,
        box_iou_3d=box_iou,
        oriented_box_iou_3d=oriented_box_iou_3d(*map(oriented_box, surfaces)),
        chamfer_l2_m=distance.l2_m,
        chamfer_squared_m2=distance.squared_m2,
        f_score=f_score(*apart_m),
    )


def score_views(
    views: Sequence[Sequence[ObjectPair]], rooms: Sequence[str], points: int = POINTS
) -> dict[str, Any]:
    """Scores of single-view reconstructions; every true object has the same weight.

    `summary` covers all objects of all images, `intervals` holds bootstrap intervals of its
    metrics, and `classes` holds one summary per true class. `rooms` names the room of each view:
    views of one room are not independent, so intervals resample rooms.
    """
    scores = [
        score_pair(pair, points, row)
        for row, pair in enumerate(pair for view in views for pair in view)
    ]
    if not scores:
        raise InputError("No image shows an object, so there is nothing to score.")
    labels = sorted({score.label for score in scores})
    by_class = {name: [score for score in scores if score.label == name] for name in labels}
    return {
        "summary": {"rooms": len(set(rooms)), "images": len(views), **summary(scores)},
        "intervals": intervals(
            scores, [room for room, view in zip(rooms, views, strict=True) for _ in view]
        ),
        "classes": {name: summary(some) for name, some in by_class.items()},
    }


def summary(scores: Sequence[PairScore]) -> dict[str, float | int | None]:
    """Means over the objects that have a value, and the numbers of objects behind them."""

    def mean(name: str) -> float | None:
        known = [value for score in scores if (value := getattr(score, name)) is not None]
        return sum(known) / len(known) if known else None

    return {
        "objects": len(scores),
        "unmatched": sum(not score.found for score in scores),
        "with_surface": sum(score.surface_known for score in scores),
        **{name: mean(attribute) for name, attribute in FIELDS.items()},
    }


def intervals(scores: Sequence[PairScore], rooms: Sequence[str]) -> dict[str, list[float] | None]:
    """Lower and upper end of the interval of each metric; None for a metric without a value.

    `rooms` names the room of each score. A room is resampled with all objects of all its views. The
    resamples depend only on the rooms, so that several methods share them.
    """
    names, number = np.unique(rooms, return_inverse=True)
    counts = resample_counts(len(names), RESAMPLES, 0)
    found = {}
    for name, attribute in FIELDS.items():
        values = [getattr(score, attribute) for score in scores]
        known = np.bincount(number, [value is not None for value in values])
        sums = np.bincount(number, [value or 0.0 for value in values])
        high = np.inf if name.startswith("chamfer") else 1.0
        found[name] = ratio(sums, known, counts, high).interval()
    return found


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


METRICS = {
    "box_iou_3d": "axis-aligned boxes in the room frame",
    "oriented_box_iou_3d": "upright boxes around the meshes, over the footprint's rectangle of "
    "least area",
    "chamfer_l2_m": "mean distance to the nearest point of the other surface, both ways added, in "
    "metres",
    "chamfer_squared_m2": "like chamfer_l2_m with squared distances, in square metres",
    "f_score": f"at {F_THRESHOLD_M} m",
}
PROTOCOL = {
    "objects": "objects that the image shows, each matched to the object fitted to its mask by the "
    "fit's own assignment (class and 2D box); every object has the same weight",
    **METRICS,
    "intervals": f"{COVERAGE:.0%} bootstrap over rooms, {RESAMPLES:,} draws with replacement, all "
    "views of a room together",
}
"""The compared objects and the metrics, as described in result files."""
FIELDS = {**{name: name for name in METRICS}, "class_accuracy": "class_right"}
"""Metrics of a summary, each the mean of this field of `PairScore`."""

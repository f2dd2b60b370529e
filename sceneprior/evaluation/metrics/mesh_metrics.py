"""Chamfer distance, F-score and box IoU of meshes and upright boxes."""

from typing import NamedTuple

import numpy as np
import shapely
import trimesh
from jaxtyping import Float

from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Mesh

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

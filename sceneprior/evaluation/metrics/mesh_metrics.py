"""Chamfer distance, F-score and box IoU of meshes and upright boxes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sceneprior.errors import InputError
from sceneprior.geometry.surfaces import nearest_distances
from sceneprior.geometry.turns import yaw_rotation
from sceneprior.scene import Mesh

POINTS = 10_000
"""Points an object's surface is compared by. Two samples of one sphere of radius 1 m are still
35 mm apart by `chamfer_sum(...).l2_m`; with 1,000 points, 112 mm."""
F_THRESHOLD_M = 0.05
"""How near a point must have a neighbour on the other surface to count for the F-score."""


def sample_surface(mesh: Mesh, count: int, seed: int) -> Float[np.ndarray, "count 3"]:
    """Draw points uniformly by area from a mesh's surface, inner faces included.

    Args:
        mesh: At least one face. Where all faces are without area, points lie on the first.
        count: How many points.
        seed: Same seed, same points.

    Raises:
        InputError: the mesh has no faces.
    """
    import trimesh

    if not len(mesh.faces):
        raise InputError(
            "A mesh without faces has no surface to draw points from; give the object a mesh with "
            "faces, or none at all: then it is its box."
        )
    surface = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    points = trimesh.sample.sample_surface(surface, count, seed=seed)[0]
    return np.asarray(points, dtype=np.float64)


def f_score(
    a_points_m: Float[np.ndarray, "n 3"],
    b_points_m: Float[np.ndarray, "m 3"],
    threshold_m: float = F_THRESHOLD_M,
) -> float:
    """Harmonic mean of the shares of a near b and of b near a, in [0, 1]; 0 where no point is near.

    Raises:
        InputError: a set is empty.
    """
    precision, recall = (
        float((way <= threshold_m).mean()) for way in nearest_distances(a_points_m, b_points_m)
    )
    return 2 * precision * recall / max(precision + recall, 1e-12)


class OrientedBoxes(NamedTuple):
    """Upright boxes that may be turned about the vertical axis."""

    centers_m: Float[np.ndarray, "n 3"]
    sizes_m: Float[np.ndarray, "n 3"]
    """Full extents along the boxes' own x, y and z."""
    yaw_rad: Float[np.ndarray, " n"]
    """Turns +z towards +x (docs/conventions.md)."""


def oriented_boxes(meshes: Sequence[Mesh]) -> OrientedBoxes:
    """The tightest upright box around each mesh: over the footprint's rectangle of least area.

    A mesh alone does not say which side is its front, and no IoU asks: yaw is in [0, pi / 2).
    A mesh that is an upright box has that box.
    """
    rows = [_tightest(np.asarray(mesh.vertices_m, dtype=np.float64)) for mesh in meshes]
    centers, sizes, yaws = zip(*rows, strict=True) if rows else ((), (), ())
    return OrientedBoxes(
        np.array(centers, dtype=np.float64).reshape(-1, 3),
        np.array(sizes, dtype=np.float64).reshape(-1, 3),
        np.array(yaws, dtype=np.float64),
    )


def _tightest(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    from shapely import MultiPoint, Polygon

    rectangle = MultiPoint(points[:, [0, 2]]).minimum_rotated_rectangle
    yaw = 0.0  # a footprint without area is any rectangle's side
    if isinstance(rectangle, Polygon):
        x, z = np.diff(np.asarray(rectangle.exterior.coords)[:2], axis=0)[0]
        yaw = float(np.arctan2(x, z) % (np.pi / 2))
    turn = yaw_rotation(yaw)
    own = points @ turn  # columns of `turn` are the box's axes
    low, high = own.min(axis=0), own.max(axis=0)
    return turn @ (low + high) / 2, high - low, yaw


def oriented_box_iou_3d(a: OrientedBoxes, b: OrientedBoxes) -> Float[np.ndarray, "n m"]:
    """Intersection over union of every box a with every box b: shared footprint x shared height.

    Two boxes without volume have IoU 0. At yaw 0 this is `box_iou_3d` of decoded_rooms.

    Example: a cube and the same cube turned by 45 degrees share a regular octagon.

        >>> cube = OrientedBoxes(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1))
        >>> turned = cube._replace(yaw_rad=np.array([np.pi / 4]))
        >>> round(float(oriented_box_iou_3d(cube, turned)[0, 0]), 6)
        0.707107
    """
    import shapely

    shared_area = shapely.area(
        shapely.intersection(_footprints(a)[:, None], _footprints(b)[None, :])
    )
    (low_a, high_a), (low_b, high_b) = _heights(a), _heights(b)
    height = np.minimum(high_a[:, None], high_b[None]) - np.maximum(low_a[:, None], low_b[None])
    shared = shared_area * np.clip(height, 0, None)
    union = a.sizes_m.prod(axis=1)[:, None] + b.sizes_m.prod(axis=1)[None] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def _footprints(boxes: OrientedBoxes) -> np.ndarray:
    """(n,) shapely polygons of x and z."""
    import shapely

    corners = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) / 2
    own = corners * boxes.sizes_m[:, None]
    room = own @ np.swapaxes(yaw_rotation(boxes.yaw_rad), 1, 2) + boxes.centers_m[:, None]
    return shapely.polygons(room[:, :, [0, 2]])


def _heights(boxes: OrientedBoxes) -> tuple[np.ndarray, np.ndarray]:
    middle, half = boxes.centers_m[:, 1], boxes.sizes_m[:, 1] / 2
    return middle - half, middle + half

"""Projects points and wireframes of a room into its views with numpy, for pictures and checks."""

import warnings
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from sceneprior.core.cameras import to_camera, to_pixels
from sceneprior.core.geometry.corners import BOX_EDGES, box_corners

WIRE_NEAR_M = 0.05
"""Depth of the near plane, at which lines are clipped."""

Segment = tuple[float, float, float, float]


def wire_pixels(
    points_m: np.ndarray,
    edges: Iterable[tuple[int, int]],
    world_to_camera: np.ndarray,
    intrinsics: np.ndarray,
) -> list[Segment]:
    """Project edges, pairs of rows of points, to lines in the image, clipped at the near plane.

    Returns u1, v1, u2, v2 of every edge that lies at least partly beyond the near plane.

    Example: a line that begins 1 m behind the camera is visible from the near plane on.

        >>> line = np.array([[0.0, 0, -1], [0.2, 0, 2]])
        >>> wire_pixels(line, [(0, 1)], np.eye(4), np.diag([10.0, 10, 1]))
        [(14.0, 0.0, 1.0, 0.0)]
    """
    camera = to_camera(*(np.asarray(part, np.float64) for part in (points_m, world_to_camera)))
    found = []
    for first, second in edges:
        a, b = camera[first], camera[second]
        if max(a[2], b[2]) < WIRE_NEAR_M:
            continue
        if a[2] < WIRE_NEAR_M:
            a = _cut(a, b)
        elif b[2] < WIRE_NEAR_M:
            b = _cut(b, a)
        ends = to_pixels(np.stack([a, b]), np.asarray(intrinsics, np.float64))
        u1, v1, u2, v2 = np.round(ends, 6).ravel().tolist()
        found.append((u1, v1, u2, v2))
    return found


def _cut(behind: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Intersection of a line with the near plane."""
    return behind + (ahead - behind) * (WIRE_NEAR_M - behind[2]) / (ahead[2] - behind[2])


class Hull(NamedTuple):
    """Vertices of a convex body, and its edges as pairs of rows."""

    points_m: np.ndarray
    """(P, 3)"""
    edges: np.ndarray
    """(E, 2)"""


def hull_of(points_m: np.ndarray) -> Hull:
    """Convex hull of points, (P, 3): it has the same projected 2D box with fewer points."""
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    try:
        # Points are joggled (QJ), because flat point sets have no hull.
        found = ConvexHull(points_m, qhull_options="QJ")
    except QhullError:
        return Hull(box_corners((low + high) / 2, high - low), np.array(BOX_EDGES))
    number = np.zeros(len(points_m), dtype=np.int64)
    number[found.vertices] = np.arange(len(found.vertices))
    edges = number[np.concatenate([found.simplices[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])]
    return Hull(points_m[found.vertices], np.unique(np.sort(edges, axis=1), axis=0))


def boxes_around(hull: Hull, world_to_camera: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """2D bounding box of a projected body in each view, not clipped at the image borders.

    (T, 4) x1, y1, x2, y2 in pixels, of the part beyond the near plane; NaN if there is none.
    """
    poses, lenses = (np.asarray(part, np.float64) for part in (world_to_camera, intrinsics))
    camera = to_camera(hull.points_m, poses)
    ahead = camera[..., 2] >= WIRE_NEAR_M
    pixels = to_pixels(np.where(ahead[..., None], camera, np.nan), lenses)
    with warnings.catch_warnings():  # nanmin warns if the whole body is behind the camera
        warnings.simplefilter("ignore", RuntimeWarning)
        boxes = np.concatenate([np.nanmin(pixels, axis=1), np.nanmax(pixels, axis=1)], axis=1)
    for view in np.flatnonzero(ahead.any(axis=1) & ~ahead.all(axis=1)):
        crossing = hull.edges[ahead[view, hull.edges].sum(axis=1) == 1]
        a, b = camera[view, crossing[:, 0]], camera[view, crossing[:, 1]]
        share = (WIRE_NEAR_M - a[:, 2:]) / (b[:, 2:] - a[:, 2:])
        cut = to_pixels(a + (b - a) * share, lenses[view])
        boxes[view, :2] = np.minimum(boxes[view, :2], cut.min(axis=0))
        boxes[view, 2:] = np.maximum(boxes[view, 2:], cut.max(axis=0))
    return boxes


def box_iou_2d(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Intersection over union of 2D boxes, row by row; NaN if a box is NaN or both are empty.

    Example: two squares that overlap by one half.

        >>> box_iou_2d(np.array([[0.0, 0, 2, 2]]), np.array([[1.0, 0, 3, 2]])).round(3).tolist()
        [0.333]
    """
    low, high = np.maximum(a[..., :2], b[..., :2]), np.minimum(a[..., 2:], b[..., 2:])
    shared = np.maximum(high - low, 0).prod(axis=-1)
    areas = [(box[..., 2:] - box[..., :2]).prod(axis=-1) for box in (a, b)]
    union = np.asarray(areas[0] + areas[1] - shared)
    return np.divide(shared, union, out=np.full(union.shape, np.nan), where=union > 0)

"""Projects points and wires of a room into its views, in numpy: for pictures and checks."""

from collections.abc import Iterable

import numpy as np

WIRE_NEAR_M = 0.05
"""Lines are cut where they come nearer to the camera than this."""

Segment = tuple[float, float, float, float]


def to_camera(points_m: np.ndarray, world_to_camera: np.ndarray) -> np.ndarray:
    """(P, 3) points in a camera's own axes (OpenCV), float64."""
    matrix = np.asarray(world_to_camera, dtype=np.float64)
    return np.asarray(points_m, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def wire_pixels(
    points_m: np.ndarray,
    edges: Iterable[tuple[int, int]],
    world_to_camera: np.ndarray,
    intrinsics: np.ndarray,
) -> list[Segment]:
    """The edges as lines on the image, each cut at the near plane or left out behind it.

    Args:
        points_m: (P, 3) in the room frame.
        edges: Pairs of rows.
        world_to_camera: (4, 4).
        intrinsics: (3, 3), pixels.

    Returns:
        u1, v1, u2, v2 of every edge of which something lies in front of the camera.

    Example: a line that begins 1 m behind the camera is seen from the near plane on.

        >>> line = np.array([[0.0, 0, -1], [0.2, 0, 2]])
        >>> wire_pixels(line, [(0, 1)], np.eye(4), np.diag([10.0, 10, 1]))
        [(14.0, 0.0, 1.0, 0.0)]
    """
    camera = to_camera(points_m, world_to_camera)
    found = []
    for first, second in edges:
        a, b = camera[first], camera[second]
        if max(a[2], b[2]) < WIRE_NEAR_M:
            continue
        if a[2] < WIRE_NEAR_M:
            a = _cut(a, b)
        elif b[2] < WIRE_NEAR_M:
            b = _cut(b, a)
        ends = (np.stack([a, b]) / [[a[2]], [b[2]]]) @ np.asarray(intrinsics, np.float64).T
        u1, v1, u2, v2 = np.round(ends[:, :2], 6).ravel().tolist()
        found.append((u1, v1, u2, v2))
    return found


def _cut(behind: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Where a line crosses the near plane."""
    return behind + (ahead - behind) * (WIRE_NEAR_M - behind[2]) / (ahead[2] - behind[2])


def boxes_around(
    points_m: np.ndarray, world_to_camera: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """The 2D box round projected points in each view, beyond the image's borders, too.

    Args:
        points_m: (P, 3) in the room frame.
        world_to_camera: (T, 4, 4).
        intrinsics: (T, 3, 3), pixels.

    Returns:
        (T, 4) x1, y1, x2, y2 in pixels; NaN where a point is nearer than the near plane.
    """
    boxes = np.full((len(world_to_camera), 4), np.nan)
    for view, (matrix, K) in enumerate(zip(world_to_camera, intrinsics, strict=True)):
        camera = to_camera(points_m, matrix)
        if camera[:, 2].min() < WIRE_NEAR_M:
            continue
        pixels = (camera / camera[:, 2:]) @ np.asarray(K, dtype=np.float64).T
        boxes[view] = (*pixels[:, :2].min(axis=0), *pixels[:, :2].max(axis=0))
    return boxes


def box_iou_2d(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Intersection over union of rows of 2D boxes; NaN where a box is NaN.

    Example: two squares that share one half.

        >>> box_iou_2d(np.array([[0.0, 0, 2, 2]]), np.array([[1.0, 0, 3, 2]])).round(3).tolist()
        [0.333]
    """
    low, high = np.maximum(a[..., :2], b[..., :2]), np.minimum(a[..., 2:], b[..., 2:])
    shared = np.maximum(high - low, 0).prod(axis=-1)
    areas = [(box[..., 2:] - box[..., :2]).prod(axis=-1) for box in (a, b)]
    return shared / (areas[0] + areas[1] - shared)

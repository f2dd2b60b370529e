"""Slow, plain twins of `sceneprior/evaluation/geometry.py`."""

import numpy as np


def winding(point: np.ndarray, triangles: np.ndarray) -> float:
    """Winding number of a surface around a point: the sum of solid angles over 4 pi."""
    total = 0.0
    for a, b, c in triangles - point:
        la, lb, lc = (np.linalg.norm(each) for each in (a, b, c))
        below = la * lb * lc + (a @ b) * lc + (b @ c) * la + (c @ a) * lb
        total += 2 * np.arctan2(a @ np.cross(b, c), below)
    return total / (4 * np.pi)


def triangles_meet(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether an edge of one triangle passes through the other, one edge at a time."""
    return any(
        edge_passes(edges[k], edges[(k + 1) % 3], face)
        for edges, face in ((a, b), (b, a))
        for k in range(3)
    )


def edge_passes(start: np.ndarray, end: np.ndarray, face: np.ndarray) -> bool:
    """Solve start + t (end - start) = face[0] + u side + v side for t, u and v."""
    system = np.stack([start - end, face[1] - face[0], face[2] - face[0]], axis=1)
    t, u, v = np.linalg.solve(system, start - face[0])
    return 0 <= t <= 1 and u >= 0 and v >= 0 and u + v <= 1

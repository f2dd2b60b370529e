"""Points on the surface of a triangle mesh (numpy)."""

import numpy as np
from jaxtyping import Float, Integer


def surface_points(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Integer[np.ndarray, "faces 3"],
    count: int,
    seed: int = 0,
) -> Float[np.ndarray, "count 3"]:
    """Draw points on a mesh, evenly by area: the same seed, the same points.

    The surface is cut into `count` pieces of equal area, face by face, and each gives one point.
    So any k-th part of the answer (`points[::k]`) again covers the surface evenly.

    Args:
        vertices: Any unit.
        faces: Corners of each triangle.
        count: How many points; at least one.
        seed: Of the places within faces.

    Raises:
        ValueError: the mesh has no area, or its area is no finite number.
    """
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    sides = corners[:, 1:] - corners[:, :1]
    ends = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).cumsum()
    if not len(ends) or not 0 < ends[-1] < np.inf:
        raise ValueError("The mesh has no area to draw points on.")
    rng = np.random.default_rng(seed)
    places = (np.arange(count) + rng.random(count)) / count * ends[-1]
    face = np.minimum(np.searchsorted(ends, places, side="right"), len(ends) - 1)
    across = rng.random((count, 2))
    # A point of the parallelogram beyond the diagonal is turned back into the triangle.
    beyond = across.sum(axis=1) > 1
    across[beyond] = 1 - across[beyond]
    return corners[face, 0] + (across[:, :, None] * sides[face]).sum(axis=1)

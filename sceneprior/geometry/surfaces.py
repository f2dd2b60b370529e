"""Points on the surface of a triangle mesh, and how far two such sets of points are apart."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Integer
from scipy.spatial import cKDTree

from sceneprior.errors import InputError


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


class ChamferSum(NamedTuple):
    """How far two sets of points are apart, both ways added; 0 for the same points."""

    l2_m: float
    """Mean distance from a to b plus mean distance from b to a, in metres: the paper's L2."""
    squared_m2: float
    """The same of squared distances, in square metres: what many others call CD."""


def chamfer_sum(
    a_points_m: Float[np.ndarray, "n 3"], b_points_m: Float[np.ndarray, "m 3"]
) -> ChamferSum:
    """The Chamfer distance of two sets of points, both ways added, as in PyTorch3D.

        sum over both ways of mean_i min_j |p_i - q_j|**k,  k = 1 and 2

    Raises:
        InputError: a set is empty.

    Example: two points, one metre apart.

        >>> chamfer_sum(np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]]))
        ChamferSum(l2_m=2.0, squared_m2=2.0)
    """
    there, back = nearest_distances(a_points_m, b_points_m)
    return ChamferSum(
        float(there.mean() + back.mean()), float((there**2).mean() + (back**2).mean())
    )


def chamfer_mean(
    a_points: Float[np.ndarray, "n 3"],
    b_points: Float[np.ndarray, "m 3"],
    a_tree: cKDTree | None = None,
) -> float:
    """Half of `chamfer_sum`: the Chamfer distance averaged over both ways, in the points' unit.

    Args:
        a_tree: Of `a_points`, where they are compared many times.
    """
    there, back = nearest_distances(a_points, b_points, a_tree)
    return float(there.mean() + back.mean()) / 2


def nearest_distances(
    a_points: Float[np.ndarray, "n 3"],
    b_points: Float[np.ndarray, "m 3"],
    a_tree: cKDTree | None = None,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"]]:
    """From each point to the nearest of the other set: from a to b, and back.

    Raises:
        InputError: a set is empty.
    """
    if not len(a_points) or not len(b_points):
        raise InputError(
            f"Surfaces are compared by points, but {len(a_points)} and {len(b_points)} came."
        )
    return cKDTree(b_points).query(a_points)[0], (a_tree or cKDTree(a_points)).query(b_points)[0]

"""Samples points on mesh surfaces, and measures Chamfer distances between point sets."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Integer
from scipy.spatial import cKDTree

from sceneprior.core.errors import InputError


def surface_points(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Integer[np.ndarray, "faces 3"],
    count: int,
    seed: int = 0,
) -> Float[np.ndarray, "count 3"]:
    """Sample points on a mesh, uniformly by area and deterministically for a seed.

    Sampling is stratified: the surface is divided into `count` strata of equal area, in the order
    of the faces, with one point each. So every k-th point (`points[::k]`) covers the surface
    evenly, too.
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
    # Points of the parallelogram beyond the diagonal are reflected into the triangle.
    beyond = across.sum(axis=1) > 1
    across[beyond] = 1 - across[beyond]
    return corners[face, 0] + (across[:, :, None] * sides[face]).sum(axis=1)


class ChamferSum(NamedTuple):
    """Chamfer distance of two point sets, summed over both directions."""

    l2_m: float
    """Mean distance from a to b plus mean distance from b to a, in metres: the paper's L2."""
    squared_m2: float
    """Sum of the mean squared distances, in square metres: the usual CD."""


def chamfer_of(there_m: Float[np.ndarray, " n"], back_m: Float[np.ndarray, " m"]) -> ChamferSum:
    """Chamfer distance of two point sets from their `nearest_distances`, summed as in PyTorch3D.

        sum over both directions of mean_i min_j |p_i - q_j|**k,  k = 1 and 2

    Example: two points, one metre apart.

        >>> a, b = np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]])
        >>> chamfer_of(*nearest_distances(a, b))
        ChamferSum(l2_m=2.0, squared_m2=2.0)
    """
    return ChamferSum(
        float(there_m.mean() + back_m.mean()), float((there_m**2).mean() + (back_m**2).mean())
    )


def chamfer_mean(
    a_points: Float[np.ndarray, "n 3"],
    b_points: Float[np.ndarray, "m 3"],
    a_tree: cKDTree | None = None,
) -> float:
    """Chamfer distance averaged over both directions, half of `chamfer_of`, in the points' unit.

    `a_tree` is a k-d tree of `a_points`; pass it if `a_points` are compared with several sets.
    """
    there, back = nearest_distances(a_points, b_points, a_tree)
    return float(there.mean() + back.mean()) / 2


def nearest_distances(
    a_points: Float[np.ndarray, "n 3"],
    b_points: Float[np.ndarray, "m 3"],
    a_tree: cKDTree | None = None,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"]]:
    """Distance of each point to its nearest neighbour in the other set: a to b, and b to a."""
    if not len(a_points) or not len(b_points):
        raise InputError(
            "Point sets to compare need at least one point each; got "
            f"{len(a_points)} and {len(b_points)}."
        )
    return cKDTree(b_points).query(a_points)[0], (a_tree or cKDTree(a_points)).query(b_points)[0]

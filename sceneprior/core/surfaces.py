"""Surfaces of occupancy grids as closed meshes, points on surfaces, Chamfer distances."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Integer
from scipy.spatial import cKDTree

from sceneprior.core.boxes import BOX_FACES, CUBE_CORNERS
from sceneprior.core.errors import InputError

MOST_FACES = 2000
SMALLEST_PIECE = 0.05
"""Connected components with less than this share of the largest's cells are dropped as floaters."""
SURE = 4.0
"""Bound to which logits are clipped, so that the surface lies about half way between a cell that is
certainly occupied and one that is certainly empty."""


def surface_of(
    logits: Float[np.ndarray, "x y z"],
    center_m: Float[np.ndarray, "3"],
    size_m: Float[np.ndarray, "3"],
    margin: float = 1.0,
    most_faces: int = MOST_FACES,
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Extract the zero level set of an object's occupancy logits inside its box.

    Only cells whose centres lie in the box are used. The outermost of them extend to the sides of
    the box, where the surface is closed with sharp corners. Small components are dropped.

    Logits are at the centres of the grid's cells, positive inside the object. `margin` is the size
    of the grid relative to the box, about the same centre; the mesh is decimated to about
    `most_faces`.

    Returns:
        Vertices in metres and outward triangles of a closed mesh, in which each edge is used
        equally often in both directions (twice each if decimation has merged two sheets). If
        nothing or everything in the box is occupied, the mesh is the box itself.

    Source:
        Lewiner et al., "Efficient implementation of Marching Cubes' cases with topological
        guarantees", JGT 2003 (scikit-image).

    Example: half a box.

        >>> logits = np.full((8, 8, 8), -4.0)
        >>> logits[:, :4] = 4.0
        >>> vertices, faces = surface_of(logits, np.zeros(3), np.full(3, 2.0))
        >>> vertices[:, 1].min().item(), vertices[:, 1].max().item()
        (-1.0, 0.0)
    """
    # Imported here (and scipy below), because other mesh decoders do not need it.
    from skimage.measure import marching_cubes

    if not np.isfinite(logits).all():
        raise ValueError("An occupancy logit is not a finite number, so there is no surface.")
    center_m, size_m = (np.asarray(value, dtype=np.float64) for value in (center_m, size_m))
    logits = logits.clip(-SURE, SURE)
    within = [
        np.abs((np.arange(cells) + 0.5) / cells - 0.5) * margin < 0.5 for cells in logits.shape
    ]
    inner = logits[np.ix_(*within)]
    if not (inner > 0).any() or (inner > 0).all():
        return CUBE_CORNERS * size_m / 2 + center_m, BOX_FACES.copy()
    # The first layer of padding continues the cells beyond the box; the second is empty and closes
    # the surface.
    beyond = np.pad(without_small_pieces(inner), 1, mode="edge")
    field = np.pad(beyond, 1, constant_values=-SURE).astype(np.float32)
    vertices, faces, *_ = marching_cubes(field, 0.0, gradient_direction="ascent")
    # Vertex i of the padded grid is the centre of cell i + first - 2.
    first = np.array([np.argmax(each) for each in within])
    unit = (vertices + (first - 1.5)) / np.array(logits.shape) - 0.5
    # Clipping first makes the sides flat, which saves faces in the decimation. The decimation may
    # move corners outwards a little, hence the second clipping.
    unit = (unit * margin).clip(-0.5, 0.5)
    unit, faces = decimate(unit, faces, most_faces)
    return unit.clip(-0.5, 0.5) * size_m + center_m, faces.astype(np.int64)


def decimate(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Integer[np.ndarray, "faces 3"],
    most_faces: int,
) -> tuple[Float[np.ndarray, "kept 3"], Integer[np.ndarray, "kept_faces 3"]]:
    """Simplify a mesh to about `most_faces` faces; a smaller mesh is returned unchanged.

    Source:
        Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics", SIGGRAPH 1997
        (fast-simplification).
    """
    if len(faces) <= most_faces:
        return vertices, faces
    import fast_simplification

    fewer, faces = fast_simplification.simplify(
        vertices.astype(np.float32), faces, target_count=most_faces
    )
    return fewer.astype(np.float64), faces


def without_small_pieces(field: Float[np.ndarray, "x y z"]) -> Float[np.ndarray, "x y z"]:
    """Make the values of small connected components negative (`SMALLEST_PIECE`).

    Cells that share a face are connected.
    """
    from scipy import ndimage

    piece, count = ndimage.label(field > 0)
    if count < 2:
        return field
    cells = np.bincount(piece.ravel())
    cells[0] = 0  # label 0 is empty space
    small = cells < SMALLEST_PIECE * cells.max()
    small[0] = False
    return np.where(small[piece], -np.abs(field), field)


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

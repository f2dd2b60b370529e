"""Geometry of object surfaces for metrics of use: rays, points inside, intersections, voxels."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sceneprior.core.boxes import BOX_FACES, CUBE_CORNERS, yaw_rotation
from sceneprior.core.scene import SceneObject, Turned

Triangles = Float[np.ndarray, "_ 3 3"]
Points = Float[np.ndarray, "_ 3"]

FLUSH_M = 1e-3
"""Distance beyond the floor up to which furniture counts as flush with the wall: floor outlines are
given to the millimetre."""
AT_ONCE = 1_000_000
"""Maximum number of pairs compared in one array."""


def own_box(item: SceneObject) -> Turned:
    """The object's oriented box; if its yaw is unknown, its axis-aligned box with yaw 0."""
    return item.turned or Turned(0.0, item.size_m)


def footprint(item: SceneObject) -> Float[np.ndarray, "4 2"]:
    """Corners (x, z) of the object's `own_box` on the floor, in order."""
    yaw_rad, size_m, _ = own_box(item)
    corners = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) / 2 * np.asarray(size_m)
    return np.asarray((corners @ yaw_rotation(yaw_rad).T + np.asarray(item.center_m))[:, ::2])


def triangles_of(item: SceneObject) -> Triangles:
    """Triangles of the object's mesh or, if it has none, of its `own_box`."""
    if item.mesh is not None:
        return np.asarray(item.mesh.vertices_m, dtype=np.float64)[item.mesh.faces]
    yaw_rad, size_m, _ = own_box(item)
    corners = CUBE_CORNERS / 2 * np.asarray(size_m)
    return np.asarray((corners @ yaw_rotation(yaw_rad).T + np.asarray(item.center_m))[BOX_FACES])


def bounds(triangles: Triangles) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner of the box around triangles."""
    points = triangles.reshape(-1, 3)
    return np.array([points.min(axis=0), points.max(axis=0)])


def area_centroid(triangles: Triangles) -> Float[np.ndarray, "3"]:
    """Mean of the triangles' centroids, weighted by area."""
    sides = triangles[:, 1:] - triangles[:, :1]
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    if areas.sum() <= 0:
        return np.asarray(triangles.reshape(-1, 3).mean(axis=0))
    return np.asarray(areas @ triangles.mean(axis=1) / areas.sum())


class Crossings(NamedTuple):
    """Intersections of triangles with the vertical lines through given points."""

    point: Int[np.ndarray, " crossings"]
    """Index of the given point."""
    height_m: Float[np.ndarray, " crossings"]
    """Height (y) of the intersection."""
    side: Int[np.ndarray, " crossings"]
    """1 if the triangle faces up there, -1 if it faces down."""


def vertical_crossings(points: Points, triangles: Triangles) -> Crossings:
    """Find where the vertical lines through points cross triangles.

    An edge that two triangles share belongs to exactly one of them, so that lines through it cross
    a closed surface an even number of times.
    """
    found = [Crossings(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64))]
    if len(points) and len(triangles):
        (low_x, _, low_z), (high_x, _, high_z) = bounds(triangles)
        x, z = points[:, 0], points[:, 2]
        near = np.flatnonzero((x >= low_x) & (x <= high_x) & (z >= low_z) & (z <= high_z))
        for some in np.array_split(near, max(1, len(near) * len(triangles) // AT_ONCE)):
            found.append(_crossings(points, some, triangles))
    return Crossings(*(np.concatenate(part) for part in zip(*found, strict=True)))


def _crossings(points: Points, rows: Int[np.ndarray, " some"], triangles: Triangles) -> Crossings:
    x, z = points[rows, 0][:, None], points[rows, 2][:, None]
    inside = np.zeros((len(rows), len(triangles)), dtype=bool)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        ax, az, bx, bz = (triangles[:, k, axis] for k in (a, b) for axis in (0, 2))
        # The half-line towards +x crosses the edge; swapping makes both directions of an edge agree
        # exactly.
        swap = az > bz
        ax, bx = np.where(swap, bx, ax), np.where(swap, ax, bx)
        az, bz = np.where(swap, bz, az), np.where(swap, az, bz)
        spans = (az <= z) & (z < bz)
        inside ^= spans & (x < ax + (z - az) * (bx - ax) / np.where(bz > az, bz - az, 1.0))
    row, triangle = np.nonzero(inside)
    corner, normal = triangles[:, 0], np.cross(
        triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    )  # fmt: skip
    upright = normal[triangle, 1]
    row, triangle, upright = (each[upright != 0] for each in (row, triangle, upright))
    at = points[rows[row]]
    flat = (at[:, ::2] - corner[triangle][:, ::2]) * normal[triangle][:, ::2]
    height = corner[triangle, 1] - flat.sum(axis=1) / upright
    return Crossings(rows[row], height, np.sign(upright).astype(np.int64))


def inside(points: Points, triangles: Triangles) -> Bool[np.ndarray, " points"]:
    """True for points inside a surface: their winding number, counted along +y, is not 0.

    Closed parts that overlap, as in most furniture models, count as their union. If the surface has
    holes, points above or below a hole may be missed.
    """
    found = vertical_crossings(points, triangles)
    above = found.height_m > points[found.point, 1]
    turns = np.bincount(found.point[above], found.side[above], minlength=len(points))
    return np.asarray(np.round(turns) != 0)


def meeting_pairs(a: Triangles, b: Triangles) -> Int[np.ndarray, "pairs 2"]:
    """Index pairs of triangles of a and b that share a point, found by the separating axis test."""
    low, high = np.maximum(bounds(a)[0], bounds(b)[0]), np.minimum(bounds(a)[1], bounds(b)[1])
    rows = np.flatnonzero(((a.min(axis=1) <= high) & (a.max(axis=1) >= low)).all(axis=1))
    columns = np.flatnonzero(((b.min(axis=1) <= high) & (b.max(axis=1) >= low)).all(axis=1))
    found = [np.zeros((0, 2), dtype=np.int64)]
    b_low, b_high = b[columns].min(axis=1), b[columns].max(axis=1)
    for some in np.array_split(rows, max(1, len(rows) * len(columns) // AT_ONCE)):
        near = (a[some].min(axis=1)[:, None] <= b_high) & (a[some].max(axis=1)[:, None] >= b_low)
        first, second = np.nonzero(near.all(axis=2))
        pairs = np.stack([some[first], columns[second]], axis=1)
        for few in np.array_split(pairs, len(pairs) // 50_000 + 1):
            found.append(few[~_separated(a[few[:, 0]], b[few[:, 1]])])
    return np.concatenate(found)


def _separated(a: Triangles, b: Triangles) -> Bool[np.ndarray, " pairs"]:
    """True for pairs of triangles that one of 17 axes separates."""
    a_sides, b_sides = (np.roll(each, -1, axis=1) - each for each in (a, b))
    a_normal, b_normal = (np.cross(each[:, 0], each[:, 1])[:, None] for each in (a_sides, b_sides))
    crossed = np.cross(a_sides[:, :, None], b_sides[:, None]).reshape(len(a), 9, 3)
    axes = np.concatenate(
        [a_normal, b_normal, crossed, np.cross(a_sides, a_normal), np.cross(b_sides, b_normal)],
        axis=1,
    )
    a_along, b_along = (np.einsum("pkc,pvc->pkv", axes, each) for each in (a, b))
    gap = np.maximum(
        a_along.min(axis=2) - b_along.max(axis=2), b_along.min(axis=2) - a_along.max(axis=2)
    )
    return np.asarray((gap > 0).any(axis=1))


def edge_hits(a: Triangles, b: Triangles) -> Points:
    """Points where an edge of one triangle of a pair passes through the other triangle."""
    found = [np.zeros((0, 3))]
    for edges, faces in ((a, b), (b, a)):
        sides = faces[:, 1:] - faces[:, :1]
        for k in range(3):
            start, along = edges[:, k], edges[:, (k + 1) % 3] - edges[:, k]
            across = np.cross(along, sides[:, 1])
            volume = (sides[:, 0] * across).sum(axis=1)
            known = volume != 0
            scale = np.where(known, volume, 1.0)
            away = start - faces[:, 0]
            u = (away * across).sum(axis=1) / scale
            turned = np.cross(away, sides[:, 0])
            v = (along * turned).sum(axis=1) / scale
            t = (sides[:, 1] * turned).sum(axis=1) / scale
            hit = known & (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)
            found.append((start + t[:, None] * along)[hit])
    return np.concatenate(found)


class Voxels(NamedTuple):
    """A solid as cells whose centres are whole multiples of the pitch."""

    cells: Bool[np.ndarray, "x y z"]
    first: Int[np.ndarray, "3"]
    """Coordinates, in pitches, of the first cell's centre."""


def voxelize(triangles: Triangles, pitch_m: float) -> Voxels:
    """Cells that a surface passes through or encloses.

    Points on the surface, at most half a pitch apart, are rounded to cells, as in trimesh's
    `voxelized(pitch).fill()`, which divides triangles until their edges are that short.
    """
    from scipy.ndimage import binary_fill_holes

    longest = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2).max(axis=1)
    steps = np.maximum(np.ceil(longest / (pitch_m / 2)), 1)
    # Steps are powers of two, so that there are few distinct grids.
    steps = 2 ** np.ceil(np.log2(steps)).astype(np.int64)
    low, high = np.round(bounds(triangles) / pitch_m).astype(np.int64)
    grid = np.zeros(high - low + 1, dtype=bool)
    for count in np.unique(steps):
        u, v = np.divmod(np.arange((count + 1) ** 2), count + 1)
        weights = np.stack([count - u - v, u, v], axis=1)[u + v <= count] / count
        some = triangles[steps == count]
        for few in np.array_split(some, len(some) * len(weights) // AT_ONCE + 1):
            points = np.round(np.matmul(weights, few) / pitch_m).astype(np.int64) - low
            # A corner's coordinate, computed as a weighted sum, may round to the next cell.
            points = points.clip(0, high - low).reshape(-1, 3)
            grid.ravel()[np.ravel_multi_index(tuple(points.T), grid.shape)] = True
    return Voxels(binary_fill_holes(grid), low)

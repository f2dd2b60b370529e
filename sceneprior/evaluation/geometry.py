"""Geometry of a room that metrics share: pairs of boxes, footprints, and surfaces as triangles."""

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


class BoxPairs(NamedTuple):
    """All pairs of boxes of a room."""

    rows: tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]
    """Indices of the first and the second box."""
    apart_m: Float[np.ndarray, "pairs 2"]
    """Distance of the centres along x and along z."""
    gaps_m: Float[np.ndarray, " pairs"]
    """Distance of the footprints on the floor; 0 if they touch or overlap."""
    volumes_m3: Float[np.ndarray, " pairs"]
    """Volume shared by the two boxes."""
    shares: Float[np.ndarray, " pairs"]
    """Shared volume as a part of the smaller box's volume."""
    depths_m: Float[np.ndarray, " pairs"]
    """Penetration depth: the smallest shift along one axis that separates the boxes."""


def box_pairs(
    centers_m: Float[np.ndarray, "objects 3"], sizes_m: Float[np.ndarray, "objects 3"]
) -> BoxPairs:
    """Compare every pair of a room's axis-aligned boxes.

    A box is larger than its object (a chair pushed under a table, a rotated object), so boxes also
    intersect in real rooms: compare results with those of real rooms.
    """
    a, b = np.triu_indices(len(centers_m), k=1)
    low, high = centers_m - sizes_m / 2, centers_m + sizes_m / 2
    shared = np.clip(np.minimum(high[a], high[b]) - np.maximum(low[a], low[b]), 0, None)
    volumes, each = shared.prod(1), sizes_m.prod(1)
    smaller = np.minimum(each[a], each[b])
    apart = np.abs(centers_m[a] - centers_m[b])[:, ::2]
    reach = (sizes_m[a] + sizes_m[b])[:, ::2] / 2
    depths = np.minimum(high[a] - low[b], high[b] - low[a]).min(axis=1, initial=np.inf)
    return BoxPairs(
        (a, b),
        apart,
        np.linalg.norm(np.maximum(apart - reach, 0), axis=1),
        volumes,
        np.divide(volumes, smaller, out=np.zeros_like(volumes), where=smaller > 0),
        np.where(volumes > 0, depths, 0.0),
    )


def own_box(item: SceneObject) -> Turned:
    """The object's oriented box; if its yaw is unknown, its axis-aligned box with yaw 0."""
    return item.turned or Turned(0.0, item.size_m)


def in_own_box(item: SceneObject, unit: Points) -> Points:
    """Move points of the unit cube about the origin into the object's `own_box`."""
    yaw_rad, size_m, _ = own_box(item)
    return np.asarray(
        (unit * np.asarray(size_m)) @ yaw_rotation(yaw_rad).T + np.asarray(item.center_m)
    )


def footprint(item: SceneObject) -> Float[np.ndarray, "4 2"]:
    """Corners (x, z) of the object's `own_box` on the floor, in order."""
    corners = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) / 2
    return in_own_box(item, corners)[:, ::2]


def triangles_of(item: SceneObject) -> Triangles:
    """Triangles of the object's mesh or, if it has none, of its `own_box`."""
    if item.mesh is not None:
        return np.asarray(item.mesh.vertices_m, dtype=np.float64)[item.mesh.faces]
    return in_own_box(item, CUBE_CORNERS / 2)[BOX_FACES]


def point_count(item: SceneObject, fewest: int) -> int:
    """Number of points that represent an object: 5,000 per cubic metre of its box, or `fewest`."""
    return max(int(np.prod(own_box(item).size_m) * 5000), fewest)


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


def reaching(triangles: Triangles, low: np.ndarray, high: np.ndarray) -> Bool[np.ndarray, " _"]:
    """True for triangles whose box reaches into the box between two corners."""
    return ((triangles.max(axis=1) >= low) & (triangles.min(axis=1) <= high)).all(axis=1)


def meeting_pairs(a: Triangles, b: Triangles) -> Int[np.ndarray, "pairs 2"]:
    """Index pairs of triangles of a and b that share a point, found by the separating axis test."""
    rows, columns = (
        np.flatnonzero(reaching(one, *bounds(other))) for one, other in ((a, b), (b, a))
    )
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

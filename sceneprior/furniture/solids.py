"""Closed solids with outward-facing triangles, the parts of all furniture; sizes in metres.

The `y` of a solid is its bottom, since furniture is described from the floor up. Most solids are
lofts: rings with equal numbers of points, joined ring to ring and capped at both ends.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh

Parts = list[trimesh.Trimesh]
"""A piece of furniture: closed solids, which may intersect."""

Number = float | int | np.number
"""A length in metres, or an angle, as written in the expressions of the tables."""

Numbers = Number | np.ndarray | Sequence[Any]
"""A number, or an array of them in any form."""

Vector = tuple[float, float, float]


def loft(rings: Numbers) -> trimesh.Trimesh:
    """Join (rings, points, 3) into one closed solid; both end rings must be convex."""
    rings = np.asarray(rings, dtype=float)
    count, points = rings.shape[:2]
    here = np.arange(points)
    after = (here + 1) % points
    faces = []
    for ring in range(count - 1):
        low, high = ring * points, (ring + 1) * points
        faces.append(np.stack([low + here, low + after, high + after], axis=1))
        faces.append(np.stack([low + here, high + after, high + here], axis=1))
    fan = np.stack([np.zeros(points - 2, int), here[1:-1], here[2:]], axis=1)
    triangles = np.concatenate([*faces, fan[:, ::-1], fan + (count - 1) * points])
    vertices = rings.reshape(-1, 3)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:  # six times the signed volume
        triangles = triangles[:, ::-1]
    return trimesh.Trimesh(vertices, triangles, process=False)


def box(
    w: Number, h: Number, d: Number, x: Number = 0.0, y: Number = 0.0, z: Number = 0.0
) -> trimesh.Trimesh:
    """Make a w x h x d box with the centre of its bottom at (x, y, z)."""
    bounds = np.array([[x - w / 2, y, z - d / 2], [x + w / 2, y + h, z + d / 2]], dtype=float)
    return trimesh.creation.box(bounds=bounds)


def beveled_box(
    w: Number,
    h: Number,
    d: Number,
    x: Number = 0.0,
    y: Number = 0.0,
    z: Number = 0.0,
    bevel: Number = 0.05,
    steps: int = 2,
) -> trimesh.Trimesh:
    """Make a box with edges rounded by `bevel` (60 triangles for steps = 2)."""
    bevel = min(bevel, 0.49 * min(w, h, d))
    rings: list[np.ndarray] = []
    angles = np.linspace(0, 1.2, steps)
    for angle in [*(-angles[::-1]), *angles]:
        inset = bevel * (1 - np.cos(angle))
        rise = np.sign(angle) * bevel * np.sin(abs(angle)) / np.sin(1.2)
        level = h / 2 + (h / 2 - bevel) * (1 if len(rings) >= steps else -1) + rise
        half_x, half_z, radius = w / 2 - inset, d / 2 - inset, max(bevel - inset, 1e-3)
        corners = []
        for quarter, (sx, sz) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)]):
            turn = np.linspace(0, np.pi / 2, steps) + quarter * np.pi / 2
            around = sx * (half_x - radius) + radius * np.cos(turn)
            corners.append(curve(around, sz * (half_z - radius) + radius * np.sin(turn)))
        outline = np.concatenate(corners)
        rings.append(np.insert(outline, 1, level, axis=1))
    return shifted(loft(rings), x, y, z)


def lathe(
    profile: list[tuple[Number, Number]], x: Number = 0.0, z: Number = 0.0, segments: int = 20
) -> trimesh.Trimesh:
    """Rotate a profile of (radius, height) pairs about the vertical axis through (x, z)."""
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    rings = []
    for radius, height in profile:
        radius = max(radius, 2e-3)  # a ring of radius 0 would make degenerate triangles
        rings.append(curve(x + radius * np.cos(turn), height, z + radius * np.sin(turn)))
    return loft(rings)


def cylinder(
    radius: Number, h: Number, x: Number = 0.0, y: Number = 0.0, z: Number = 0.0, segments: int = 20
) -> trimesh.Trimesh:
    """Make a vertical cylinder with the centre of its bottom at (x, y, z)."""
    return lathe([(radius, y), (radius, y + h)], x, z, segments)


def sphere(
    radius: Number, x: Number = 0.0, y: Number = 0.0, z: Number = 0.0, rows: int = 8
) -> trimesh.Trimesh:
    """Make a sphere with its lowest point at (x, y, z)."""
    polar = np.linspace(0.08, np.pi - 0.08, rows)
    profile = [(radius * np.sin(a), y + radius * (1 - np.cos(a))) for a in polar]
    return lathe(profile, x, z, 2 * rows)


def torus(radius: Number, thickness: Number, y: Number = 0.0) -> trimesh.Trimesh:
    """Make a horizontal torus with its bottom at y and outer radius `radius`."""
    sections = {"major_sections": 28, "minor_sections": 8}
    part = trimesh.creation.torus(radius - thickness / 2, thickness / 2, **sections)
    return shifted(tilted(part, np.pi / 2), y=y + thickness / 2)


def panel(outline_xy: Numbers, thickness: Number, z: Number = 0.0) -> trimesh.Trimesh:
    """Extrude a convex outline in the x-y plane by `thickness` along z, centred at z."""
    outline = np.asarray(outline_xy, dtype=float)
    return loft([np.insert(outline, 2, z + side * thickness / 2, axis=1) for side in (-1, 1)])


def slab(outline_xz: Numbers, h: Number, y: Number = 0.0) -> trimesh.Trimesh:
    """Extrude a convex outline in the x-z plane by `h` upwards, from y."""
    outline = np.asarray(outline_xz, dtype=float)
    return loft([np.insert(outline, 1, level, axis=1) for level in (y, y + h)])


def tube(points: Numbers, radius: Number, segments: int = 8) -> trimesh.Trimesh:
    """Make a round bar along a path (points, 3) without sharp reversals."""
    points = np.asarray(points, dtype=float)
    along = _directions(points)
    # A single reference vector for all rings avoids twist.
    reference = np.eye(3)[np.argmin(np.abs(along).max(axis=0))]
    rings = []
    for point, direction in zip(points, along, strict=True):
        rings.append(point + radius * _circle(direction, np.cross(direction, reference), segments))
    return loft(rings)


def rod(
    start: Numbers, end: Numbers, radius: Number, end_radius: Number | None = None
) -> trimesh.Trimesh:
    """Make a straight bar with 6 sides, tapering to `end_radius`."""
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    along = (end - start) / np.linalg.norm(end - start)
    circle = _circle(along, np.cross(along, np.eye(3)[np.argmin(np.abs(along))]), 6)
    return loft([start + radius * circle, end + (end_radius or radius) * circle])


def _circle(axis: np.ndarray, side: np.ndarray, segments: int) -> np.ndarray:
    """Points of the unit circle about an axis, (segments, 3), starting towards `side`."""
    side = side / np.linalg.norm(side)
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)[:, None]
    return np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)


def _directions(points: np.ndarray) -> np.ndarray:
    """Unit tangents of a path at its points."""
    along = np.gradient(points, axis=0)
    return along / np.linalg.norm(along, axis=1, keepdims=True)


def ribbon(path_xz: Numbers, y0: Number, y1: Numbers, thickness: Number) -> trimesh.Trimesh:
    """Make a wall along a path (points, 2) in x and z, from y0 to y1 (one value or per point)."""
    path = np.asarray(path_xz, dtype=float)
    along = _directions(path)
    across = curve(along[:, 1], -along[:, 0]) * thickness / 2
    sides = ((path + across, y0), (path - across, y0), (path - across, y1), (path + across, y1))
    return loft(np.stack([curve(at[:, 0], y, at[:, 1]) for at, y in sides], axis=1))


def curve(*coordinates: Numbers) -> np.ndarray:
    """Stack coordinates to points, (points, 2 or 3); a single number is broadcast."""
    return np.stack(np.broadcast_arrays(*coordinates), axis=1)


def oval(w: Number, d: Number, segments: int = 24, power: Number = 2.0) -> np.ndarray:
    """Outline of a (super)ellipse, (segments, 2); a power above 2 makes it more rectangular."""
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    cos, sin = np.cos(turn), np.sin(turn)
    x = w / 2 * np.sign(cos) * np.abs(cos) ** (2 / power)
    return curve(x, d / 2 * np.sign(sin) * np.abs(sin) ** (2 / power))


def arch(w: Number, h: Number, shoulder: Number, steps: int = 10) -> np.ndarray:
    """Outline of a panel of width w, (steps + 2, 2), whose top curves from `shoulder` up to h."""
    turn = np.linspace(0, np.pi, steps)
    top = curve(w / 2 * np.cos(turn), shoulder + (h - shoulder) * np.sin(turn))
    return np.concatenate([top, [[-w / 2, 0.0], [w / 2, 0.0]]])


def shifted(part: Any, x: Number = 0.0, y: Number = 0.0, z: Number = 0.0):
    """Translate a part, or each part of a list, in place."""
    for each in part if isinstance(part, list) else [part]:
        each.apply_translation([x, y, z])
    return part


def tilted(
    part: trimesh.Trimesh, angle_rad: Number, about: Numbers = (0.0, 0.0, 0.0)
) -> trimesh.Trimesh:
    """Rotate the part in place about the x axis through a point."""
    return part.apply_transform(
        trimesh.transformations.rotation_matrix(angle_rad, [1, 0, 0], about)
    )


def scaled(part: trimesh.Trimesh, factors: Numbers) -> trimesh.Trimesh:
    """Scale the part in place along x, y and z."""
    return part.apply_scale(factors)


def fit_to(parts: Parts, size_m: Numbers) -> Parts:
    """Scale the parts together to a bounding box of this size, centred, bottom at y = 0."""
    low = np.min([part.vertices.min(axis=0) for part in parts], axis=0)
    high = np.max([part.vertices.max(axis=0) for part in parts], axis=0)
    anchor = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    stretch = np.asarray(size_m, dtype=float) / (high - low)
    return [
        trimesh.Trimesh((part.vertices - anchor) * stretch, part.faces, process=False)
        for part in parts
    ]


PARTS = {
    part.__name__: part
    for part in (
        box, beveled_box, lathe, cylinder, sphere, torus, panel, slab, tube, rod, ribbon,
        curve, oval, arch, shifted, tilted, scaled,
    )
}  # fmt: skip
"""Functions that a table of parts may use, by name."""

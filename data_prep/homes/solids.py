"""Plain closed solids, the bricks of all furniture: sizes in metres in, outward-facing meshes out.

Every solid stands on its own `y`: a piece is described from the floor up, as a joiner would.
Most are a loft: rings of equally many points, joined ring to ring, capped at both ends.
"""

import numpy as np
import trimesh
from numpy.typing import ArrayLike

Parts = list[trimesh.Trimesh]
"""A piece of furniture: closed solids, which may interpenetrate."""


def loft(rings: ArrayLike) -> trimesh.Trimesh:
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
    faces.append(fan[:, ::-1])
    faces.append(fan + (count - 1) * points)
    return _outward(rings.reshape(-1, 3), np.concatenate(faces))


def _outward(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    signed_volume = np.einsum("ij,ij->", a, np.cross(b, c))
    if signed_volume < 0:
        faces = faces[:, ::-1]
    return trimesh.Trimesh(vertices, faces, process=False)


def block(
    w: float, h: float, d: float, x: float = 0.0, y: float = 0.0, z: float = 0.0
) -> trimesh.Trimesh:
    """A box, w x h x d, that stands with the middle of its bottom at (x, y, z)."""
    bounds = [[x - w / 2, y, z - d / 2], [x + w / 2, y + h, z + d / 2]]
    return trimesh.creation.box(bounds=bounds)


def _rounded_rectangle(half_x: float, half_z: float, radius: float, steps: int) -> np.ndarray:
    angles = np.linspace(0, np.pi / 2, steps)
    corners = []
    for quarter, (sx, sz) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)]):
        turn = angles + quarter * np.pi / 2
        corners.append(
            np.stack(
                [
                    sx * (half_x - radius) + radius * np.cos(turn),
                    sz * (half_z - radius) + radius * np.sin(turn),
                ],
                axis=1,
            )
        )
    return np.concatenate(corners)


def soft_block(
    w: float,
    h: float,
    d: float,
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    radius: float = 0.05,
    steps: int = 2,
) -> trimesh.Trimesh:
    """A cushion: a box whose edges are rounded by `radius` (60 triangles for steps = 2)."""
    radius = min(radius, 0.49 * min(w, h, d))
    rings: list[np.ndarray] = []
    angles = np.linspace(0, 1.2, steps)
    for angle in [*(-angles[::-1]), *angles]:
        inset = radius * (1 - np.cos(angle))
        rise = np.sign(angle) * radius * np.sin(abs(angle)) / np.sin(1.2)
        level = h / 2 + (h / 2 - radius) * (1 if len(rings) >= steps else -1) + rise
        outline = _rounded_rectangle(w / 2 - inset, d / 2 - inset, max(radius - inset, 1e-3), steps)
        rings.append(np.insert(outline, 1, level, axis=1))
    part = loft(rings)
    part.apply_translation([x, y, z])
    return part


def lathe(
    profile: list[tuple[float, float]], x: float = 0.0, z: float = 0.0, segments: int = 20
) -> trimesh.Trimesh:
    """Turn a profile of (radius, height) pairs about the upright axis through (x, z)."""
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    rings = []
    for radius, height in profile:
        radius = max(radius, 2e-3)  # a ring of one point would make empty triangles
        ring = [x + radius * np.cos(turn), np.full(segments, height), z + radius * np.sin(turn)]
        rings.append(np.stack(ring, axis=1))
    return loft(rings)


def disc(
    radius: float, h: float, x: float = 0.0, y: float = 0.0, z: float = 0.0, segments: int = 20
) -> trimesh.Trimesh:
    """An upright cylinder that stands at (x, y, z)."""
    return lathe([(radius, y), (radius, y + h)], x, z, segments)


def ball(
    radius: float, x: float = 0.0, y: float = 0.0, z: float = 0.0, rows: int = 8
) -> trimesh.Trimesh:
    """A sphere that stands at (x, y, z)."""
    polar = np.linspace(0.08, np.pi - 0.08, rows)
    profile = [(radius * np.sin(a), y + radius * (1 - np.cos(a))) for a in polar]
    return lathe(profile, x, z, 2 * rows)


def panel(outline_xy: ArrayLike, thickness: float, z: float = 0.0) -> trimesh.Trimesh:
    """A convex outline in the x-y plane, `thickness` deep along z, its middle at z."""
    outline = np.asarray(outline_xy, dtype=float)
    ring = [np.insert(outline, 2, z + side * thickness / 2, axis=1) for side in (-1, 1)]
    return loft(ring)


def slab(outline_xz: ArrayLike, h: float, y: float = 0.0) -> trimesh.Trimesh:
    """A convex outline seen from above, `h` thick, its underside at y."""
    outline = np.asarray(outline_xz, dtype=float)
    return loft([np.insert(outline, 1, level, axis=1) for level in (y, y + h)])


def oval(w: float, d: float, segments: int = 24, power: float = 2.0) -> np.ndarray:
    """(segments, 2) outline of a (super)ellipse; a power above 2 squares its corners."""
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    cos, sin = np.cos(turn), np.sin(turn)
    stretch = 2 / power
    x = w / 2 * np.sign(cos) * np.abs(cos) ** stretch
    return np.stack([x, d / 2 * np.sign(sin) * np.abs(sin) ** stretch], axis=1)


def arch(w: float, h: float, shoulder: float, steps: int = 10) -> np.ndarray:
    """(steps + 2, 2) outline of a panel w wide whose top curves from `shoulder` up to h."""
    turn = np.linspace(0, np.pi, steps)
    top = np.stack([w / 2 * np.cos(turn), shoulder + (h - shoulder) * np.sin(turn)], axis=1)
    return np.concatenate([top, [[-w / 2, 0.0], [w / 2, 0.0]]])


def tube(points: ArrayLike, radius: float, segments: int = 8) -> trimesh.Trimesh:
    """A round bar along (points, 3), which must not double back."""
    points = np.asarray(points, dtype=float)
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # One reference for the whole bar keeps its rings from twisting.
    reference = np.eye(3)[np.argmin(np.abs(along).max(axis=0))]
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)[:, None]
    rings = []
    for point, direction in zip(points, along, strict=True):
        side = np.cross(direction, reference)
        side /= np.linalg.norm(side)
        rings.append(
            point + radius * (np.cos(turn) * side + np.sin(turn) * np.cross(direction, side))
        )
    return loft(rings)


def rod(
    start: ArrayLike, end: ArrayLike, radius: float, end_radius: float | None = None
) -> trimesh.Trimesh:
    """A straight round bar, tapering to `end_radius`; 6 sides."""
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    along = (end - start) / np.linalg.norm(end - start)
    side = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    side /= np.linalg.norm(side)
    turn = np.linspace(0, 2 * np.pi, 6, endpoint=False)[:, None]
    circle = np.cos(turn) * side + np.sin(turn) * np.cross(along, side)
    return loft([start + radius * circle, end + (end_radius or radius) * circle])


def ribbon(path_xz: ArrayLike, y0: float, y1: ArrayLike, thickness: float) -> trimesh.Trimesh:
    """A wall that follows (points, 2) seen from above, from y0 up to y1 (one or one a point)."""
    path = np.asarray(path_xz, dtype=float)
    tops = np.broadcast_to(np.asarray(y1, dtype=float), len(path))
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack([along[:, 1], -along[:, 0]], axis=1) * thickness / 2
    rings = []
    for point, side, top in zip(path, across, tops, strict=True):
        outer, inner = point + side, point - side
        rings.append([[*_at(outer, y0)], [*_at(inner, y0)], [*_at(inner, top)], [*_at(outer, top)]])
    return loft(rings)


def _at(point_xz: np.ndarray, y: float) -> tuple[float, float, float]:
    return point_xz[0], y, point_xz[1]


def ring(radius: float, thickness: float, y: float = 0.0) -> trimesh.Trimesh:
    """A hoop lying flat, standing on y; `radius` reaches to its outer edge."""
    part = trimesh.creation.torus(
        radius - thickness / 2, thickness / 2, major_sections=28, minor_sections=8
    )
    part.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    part.apply_translation([0, y + thickness / 2, 0])
    return part


def tilted(
    part: trimesh.Trimesh, angle_rad: float, axis: ArrayLike, about: ArrayLike
) -> trimesh.Trimesh:
    """The part, turned in place about an axis through a point."""
    part.apply_transform(trimesh.transformations.rotation_matrix(angle_rad, axis, about))
    return part


def fit_to(parts: Parts, size_m: ArrayLike) -> Parts:
    """Stretch the parts together into a box of this size, centred, bottom at y = 0."""
    size = np.asarray(size_m, dtype=float)
    low = np.min([part.vertices.min(axis=0) for part in parts], axis=0)
    high = np.max([part.vertices.max(axis=0) for part in parts], axis=0)
    anchor = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    stretch = size / (high - low)
    fitted = []
    for part in parts:
        fitted.append(
            trimesh.Trimesh((part.vertices - anchor) * stretch, part.faces, process=False)
        )
    return fitted

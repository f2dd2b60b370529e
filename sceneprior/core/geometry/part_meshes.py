"""Closed triangle meshes of furniture in parts."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sceneprior.core.geometry.corners import CUBE_CORNERS
from sceneprior.core.parts import BOWL, BOX, CYLINDER, DOME, SQUARE, Parts, center_and_radii

if TYPE_CHECKING:
    from manifold3d import Manifold

SIDES = 16
"""Corners of a circle; a multiple of four."""
OVERLAP = 5e-4
"""Length by which each part grows, as a share of the box, so that parts which touch become one
solid."""
THIN_M = 0.08
"""Thickness up to which a part keeps its size in metres when its object is stretched."""
MOST_THIN = 0.7
"""Largest share of an axis that such parts may take together; beyond it, they are stretched."""


def surface_of_parts(
    parts: Parts,
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Vertices, in the frame of the object's box, and outward triangles of the union of all parts
    within the outline.

    The mesh is closed: every edge belongs to two triangles.
    """
    from manifold3d import Manifold, OpType  # imported here: reading a scene does not need it

    solids = [_solid(kind, ends) for kind, ends in parts.solids()]
    united: Manifold = Manifold.batch_boolean(solids, OpType.Add)
    if not np.array_equal(parts.outline, SQUARE):
        united = united ^ prism(parts.outline, -1.0, 1.0)
    vertices, faces = triangles_of(united.simplify(OVERLAP))
    return vertices.clip(-0.5, 0.5), faces


def convex_surface(
    points: Float[np.ndarray, "points 3"],
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Vertices and outward triangles of the convex hull of points."""
    from manifold3d import Manifold

    return triangles_of(Manifold.hull_points(points))


def triangles_of(
    solid: "Manifold",
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Vertices and outward triangles of a solid."""
    mesh = solid.to_mesh64()
    vertices = np.asarray(mesh.vert_properties[:, :3], dtype=np.float64)
    return vertices, np.asarray(mesh.tri_verts, dtype=np.int64)


def prism(outline: Float[np.ndarray, "corners 2"], low: float, high: float) -> "Manifold":
    """The upright solid over an outline (x, z) of either orientation, between two heights."""
    from manifold3d import CrossSection, FillRule

    flat = CrossSection([np.asarray(outline, np.float64)], FillRule.NonZero)
    # Extruded along its third axis, which becomes y.
    to_room = np.array([[1, 0, 0, 0], [0, 0, 1, low], [0, 1, 0, 0]])
    return flat.extrude(high - low).transform(to_room)


def _solid(kind: int, ends: Float[np.ndarray, "3 2"]) -> "Manifold":
    from manifold3d import Manifold

    return Manifold.hull_points(solid_points(kind, ends + np.array([-OVERLAP, OVERLAP])))


def solid_points(kind: int, ends: Float[np.ndarray, "3 2"]) -> Float[np.ndarray, "points 3"]:
    """Points whose convex hull is a solid; circles have `SIDES` corners."""
    if kind == BOX:
        corners = CUBE_CORNERS / 2 * (ends[:, 1] - ends[:, 0]) + ends.mean(axis=1)
    else:
        center, radii = center_and_radii(kind, ends)
        turns = np.arange(SIDES) * 2 * np.pi / SIDES
        circle = np.stack([np.cos(turns), np.zeros(SIDES), np.sin(turns)], axis=1)
        if kind == CYLINDER:
            rings = [circle + np.array([0, height, 0]) for height in (-1, 1)]
        else:
            low, high = {DOME: (0, 1), BOWL: (-1, 0)}.get(kind, (-1, 1))
            steps = SIDES // 4 * (high - low) + 1
            rises = np.linspace(low, high, steps) * np.pi / 2
            rings = [np.cos(rise) * circle + np.array([0, np.sin(rise), 0]) for rise in rises]
        corners = np.concatenate(rings) * radii + center
    return corners


class Stretch(NamedTuple):
    """A way to stretch an object to other extents: thin parts keep their thickness in metres, and
    the rest is stretched."""

    size_m: Float[np.ndarray, "3"]
    """The object's own extents."""
    knots: tuple[Float[np.ndarray, " knots"], ...]
    """Ends of the parts along each axis, in ascending order, in the frame of the object's box."""
    kept: tuple[Bool[np.ndarray, " intervals"], ...]
    """True for intervals between knots that keep their length in metres."""

    @classmethod
    def of(cls, parts: Parts, size_m: Float[np.ndarray, "3"]) -> "Stretch":
        """The stretch of an object that consists of `parts`."""
        solids = np.stack([ends for _, ends in parts.solids()])
        knots, kept = [], []
        for axis in range(3):
            ends = solids[:, axis]
            knots.append(np.unique(np.concatenate([[-0.5, 0.5], ends.ravel()])))
            middles = (knots[-1][1:] + knots[-1][:-1]) / 2
            thin = ends[ends[:, 1] - ends[:, 0] <= THIN_M / size_m[axis]]
            inside = (middles[:, None] > thin[:, 0]) & (middles[:, None] < thin[:, 1])
            kept.append(inside.any(axis=1))
        return cls(size_m, tuple(knots), tuple(kept))

    def moved(
        self, points: Float[np.ndarray, "points 3"], new_size_m: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "points 3"]:
        """Move points of the object, in the frame of its box, to where they are in a box of the
        extents `new_size_m`, in the frame of that box."""
        moved = points.copy()
        for axis, (knots, kept) in enumerate(zip(self.knots, self.kept, strict=True)):
            lengths = np.diff(knots)
            kept_length = (lengths * kept).sum() * self.size_m[axis] / new_size_m[axis]
            if kept.all() or kept_length > MOST_THIN:
                continue
            rest = (1 - kept_length) / (lengths * ~kept).sum()
            scale = np.where(kept, self.size_m[axis] / new_size_m[axis], rest)
            places = np.concatenate([[0], np.cumsum(lengths * scale)]) - 0.5
            moved[:, axis] = np.interp(points[:, axis], knots, places)
        return moved

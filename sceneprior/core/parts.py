"""Furniture as a few solid parts cut to an outline: boxes, upright cylinders, ellipsoids and half
ellipsoids.

Parts lie in the frame of their object's box, which spans [-0.5, 0.5] along each axis. A part may be
mirrored to the other side of the frame along x, along z, or along both, so that one part can be all
four legs of a table. Every part is convex. An object is the union of its parts, cut to its outline,
which is a polygon seen from above: a sofa may have a curved side although its parts are boxes.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from sceneprior.core.boxes import CUBE_CORNERS
from sceneprior.core.errors import InputError

if TYPE_CHECKING:
    from manifold3d import Manifold

_FARTHEST_M = 1e6
KINDS = 5
BOX, CYLINDER, ELLIPSOID, DOME, BOWL = range(KINDS)
"""Kinds of parts. A part is inscribed in its box. Cylinders are upright; a dome is the upper half
of an ellipsoid, and a bowl the lower half."""
KIND_NAMES: tuple[Literal["box", "cylinder", "ellipsoid", "dome", "bowl"], ...] = (
    "box", "cylinder", "ellipsoid", "dome", "bowl"
)  # fmt: skip
"""Names of the kinds, in the order of their numbers."""
ACROSS_X, ACROSS_Z = 1, 2
"""Bits of `Parts.mirrored`: the part has a mirror image along this axis."""
MOST_PARTS = 10
"""Maximum number of parts of an object, without mirror images."""
MOST_CORNERS = 24
"""Maximum number of corners of an outline."""
SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
"""Outline that is the whole box seen from above, so that it cuts nothing off."""


class Parts(NamedTuple):
    """The parts of one object."""

    kind: Int[np.ndarray, " parts"]
    mirrored: Int[np.ndarray, " parts"]
    """0, `ACROSS_X`, `ACROSS_Z`, or the sum of both."""
    ends: Float[np.ndarray, "parts 3 2"]
    """Lower and upper end of each part along x, y and z."""
    outline: Float[np.ndarray, "corners 2"] = SQUARE
    """Corners (x, z) of a simple polygon, counter-clockwise with x to the right and z up."""

    def solids(self) -> Iterator[tuple[int, Float[np.ndarray, "3 2"]]]:
        """Kind and ends of all parts and mirror images, which may touch or overlap. They are not
        cut to the outline."""
        for kind, mirrored, ends in zip(self.kind, self.mirrored, self.ends, strict=True):
            copies = [ends]
            for bit, axis in ((ACROSS_X, 0), (ACROSS_Z, 2)):
                if mirrored & bit:
                    others = [each.copy() for each in copies]
                    for other in others:
                        other[axis] = -other[axis, ::-1]
                    copies += others
            yield from ((int(kind), each) for each in copies)


def whole_box() -> Parts:
    """The object's box as its only part."""
    return Parts(np.array([BOX]), np.array([0]), np.array([[[-0.5, 0.5]] * 3]))


def inside(
    kind: int, ends: Float[np.ndarray, "3 2"], points: Float[np.ndarray, "*points 3"]
) -> Bool[np.ndarray, "*points"]:
    """True for points in a solid."""
    low, high = ends[:, 0], ends[:, 1]
    within = ((points >= low) & (points <= high)).all(axis=-1)
    if kind == BOX:
        return np.asarray(within)
    center, radii = center_and_radii(kind, ends)
    squares = ((points - center) / radii) ** 2
    if kind == CYLINDER:
        squares = squares[..., ::2]
    found: np.ndarray = within & (squares.sum(axis=-1) <= 1)
    return found


def center_and_radii(
    kind: int, ends: Float[np.ndarray, "3 2"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Centre and radii of the full ellipsoid of a part that is an ellipsoid or half of one; for a
    cylinder, the radii along x and z are those of its base."""
    center, radii = ends.mean(axis=1), (ends[:, 1] - ends[:, 0]) / 2
    if kind in (DOME, BOWL):
        center[1], radii[1] = ends[1, 0 if kind == DOME else 1], 2 * radii[1]
    return center, radii


def filled_cells(parts: Parts, cells: int, margin: float) -> Bool[np.ndarray, "x y z"]:
    """True for grid cells whose centres lie in a part and within the outline; the grid is `margin`
    times as large as the box."""
    middles = ((np.arange(cells) + 0.5) / cells - 0.5) * margin
    points = np.stack(np.meshgrid(middles, middles, middles, indexing="ij"), axis=-1)
    found = np.zeros(points.shape[:3], bool)
    for kind, ends in parts.solids():
        found |= inside(kind, ends, points)
    if not np.array_equal(parts.outline, SQUARE):
        seen = points[:, 0, :, ::2]
        found &= shapely.contains_xy(shapely.Polygon(parts.outline), *np.moveaxis(seen, 2, 0))[
            :, None
        ]
    return found


SIDES = 16
"""Corners of a circle; a multiple of four."""
OVERLAP = 5e-4
"""Length by which each part grows, as a share of the box, so that parts which touch become one
solid."""
SAME = 1e-6
"""Distance, as a share of the box, up to which vertices of a mesh count as equal."""
THIN_M = 0.08
"""Thickness up to which a part keeps its size in metres when its object is stretched."""
MOST_THIN = 0.7
"""Largest share of an axis that such parts may take together; beyond it, they are stretched."""


def surface_of_parts(
    parts: Parts,
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Vertices, in the frame of the object's box, and outward triangles of the union of all parts
    within the outline.

    The mesh is closed, even once equal vertices are merged: every edge belongs to two triangles.
    """
    from manifold3d import Manifold, OpType  # imported here: reading a scene does not need it

    # Parts may touch in a single edge, which four triangles share; grown by other lengths, each by
    # its own, they do not.
    for more in range(8):
        grown = OVERLAP * np.array([-1.0, 1.0])
        solids = [
            Manifold.hull_points(solid_points(kind, ends + grown * (1 + more * (0.3 + row / 7))))
            for row, (kind, ends) in enumerate(parts.solids())
        ]
        united: Manifold = Manifold.batch_boolean(solids, OpType.Add)
        if not np.array_equal(parts.outline, SQUARE):
            united = united ^ prism(parts.outline, -1.0, 1.0)
        # Cutting to the box moves corners onto each other, so edges without length are removed.
        within = united.simplify(OVERLAP).warp_batch(lambda points: points.clip(-0.5, 0.5))
        vertices, faces = triangles_of(within.simplify(10 * SAME))
        if is_closed(vertices, faces):
            break
    return vertices, faces


def is_closed(vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> bool:
    """True if, once vertices within `SAME` are merged, every edge has a face on either side."""
    merged = np.unique((vertices / SAME).round(), axis=0, return_inverse=True)[1].reshape(-1)
    start, end = merged[faces].ravel(), merged[np.roll(faces, -1, axis=1)].ravel()
    edges = np.sort(start * len(vertices) + end)
    backwards = np.sort(end * len(vertices) + start)
    return bool((start != end).all() and np.diff(edges).all() and np.array_equal(edges, backwards))


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

    if not (np.abs([*np.ravel(outline), low, high]) < _FARTHEST_M).all():
        raise InputError("A part of an object is endlessly large: its prior or file is damaged.")
    flat = CrossSection([np.asarray(outline, np.float64)], FillRule.NonZero)
    # Extruded along its third axis, which becomes y.
    to_room = np.array([[1, 0, 0, 0], [0, 0, 1, low], [0, 1, 0, 0]])
    return flat.extrude(high - low).transform(to_room)


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


def stretched_parts(parts: Parts, own: Stretch, new_size_m: Float[np.ndarray, "3"]) -> Parts:
    """Stretch parts, in the frame of the object's box, to a box of the extents `new_size_m`."""
    corners = parts.ends.transpose(0, 2, 1).reshape(-1, 3)
    points = np.concatenate([corners, np.insert(parts.outline, 1, 0.0, axis=1)])
    corners, outline = np.split(own.moved(points, new_size_m), [len(corners)])
    return parts._replace(
        ends=corners.reshape(-1, 2, 3).transpose(0, 2, 1),
        outline=parts.outline if np.array_equal(parts.outline, SQUARE) else outline[:, ::2],
    )

"""Furniture as a few solid parts cut to an outline: boxes, upright cylinders, ellipsoids and half
ellipsoids.

Parts lie in the frame of their object's box, which spans [-0.5, 0.5] along each axis. A part may be
mirrored to the other side of the frame along x, along z, or along both, so that one part can be all
four legs of a table. Every part is convex. An object is the union of its parts, cut to its outline,
which is a polygon seen from above: a sofa may have a curved side although its parts are boxes.
"""

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

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
                    copies += [_across(each, axis) for each in copies]
            yield from ((int(kind), each) for each in copies)


def _across(ends: Float[np.ndarray, "3 2"], axis: int) -> Float[np.ndarray, "3 2"]:
    other = ends.copy()
    other[axis] = -ends[axis, ::-1]
    return other


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

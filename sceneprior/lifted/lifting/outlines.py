"""Outlines of furniture seen from above: extraction from visual hulls, rays cut to them, areas."""

from typing import no_type_check

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from numba import njit

from sceneprior.core.parts import MOST_CORNERS, SQUARE

SMOOTHED = 0.3
"""Tolerance in cells of the simplification of outlines. Contours cut the corners of cells
diagonally, and with a larger tolerance these cuts would slant the sides of rectangles."""
FULL = 0.97
"""Share of the box's area above which an outline is replaced by the whole box."""


def outline_of(hull: Bool[np.ndarray, "x y z"]) -> Float[np.ndarray, "corners 2"]:
    """Outline of the largest piece of a visual hull seen from above, scaled to touch all four sides
    of the object's box; `SQUARE` if the hull nearly fills the box, or is empty. The hull's grid
    spans the box."""
    from skimage.measure import (
        find_contours,  # imported here, since `explain_rays` does not need it
    )

    seen = np.pad(hull.any(axis=1), 1).astype(np.float64)
    found = [shapely.Polygon(line) for line in find_contours(seen, 0.5) if len(line) > 3]
    if not found:
        return SQUARE
    largest = max(found, key=lambda each: float(each.area))
    tolerance = SMOOTHED
    while len((polygon := largest.simplify(tolerance)).exterior.coords) - 1 > MOST_CORNERS:
        tolerance *= 1.25
    corners = shapely.get_coordinates(shapely.geometry.polygon.orient(polygon))[:-1]
    low, high = corners.min(axis=0), corners.max(axis=0)
    if (high - low).min() < 3:
        return SQUARE
    outline: np.ndarray = (corners - low) / (high - low) - 0.5
    return outline if shapely.Polygon(outline).area <= FULL else SQUARE


# no_type_check: the tests' type hook wraps every function, and Numba cannot compile a wrapper.
@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def within(start, span, outline):
    """Shares of a segment's length, from `start` to `start` + `span`, at which the segment first
    enters and last leaves the prism over an outline; (1, 0) if it never meets the prism."""
    near, far = 1.0, 0.0
    first, last = False, False  # whether the segment's ends lie inside
    corners = len(outline)
    for corner in range(corners):
        x1, z1 = outline[corner - 1 if corner else corners - 1]
        x2, z2 = outline[corner]
        edge_x, edge_z = x2 - x1, z2 - z1
        for end in range(2):
            x, z = start[0] + end * span[0], start[2] + end * span[2]
            if (z1 > z) != (z2 > z) and x < x1 + (z - z1) / edge_z * edge_x:
                if end:
                    last = not last
                else:
                    first = not first
        across = span[0] * edge_z - span[2] * edge_x
        if across == 0:
            continue
        from_x, from_z = x1 - start[0], z1 - start[2]
        along = (from_x * edge_z - from_z * edge_x) / across
        on_edge = (from_x * span[2] - from_z * span[0]) / across
        if 0 <= along <= 1 and 0 <= on_edge <= 1:
            near, far = min(near, along), max(far, along)
    return 0.0 if first else near, 1.0 if last else far


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def cut_rays(starts, spans, outline):
    """Shorten segments, in place, to the range between their first and last point within an
    outline. Segments without such a point get a span of 0. In an outline with a notch, this range
    may include points outside."""
    for ray in range(len(starts)):
        near, far = within(starts[ray], spans[ray], outline)
        for axis in range(3):
            starts[ray, axis] += near * spans[ray, axis]
            spans[ray, axis] *= max(far - near, 0.0)


def area_table(
    outline: Float[np.ndarray, "corners 2"], levels: int
) -> Int[np.ndarray, "edges edges"]:
    """Number of cells, of a grid over the box, at lower x and z whose centres lie within an
    outline (a summed-area table)."""
    centres = (np.arange(levels) + 0.5) / levels - 0.5
    inside = shapely.contains_xy(shapely.Polygon(outline), *np.meshgrid(centres, centres))
    return np.pad(inside.T.astype(np.int64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))


def points_within(
    outline: Float[np.ndarray, "corners 2"], count: int
) -> Float[np.ndarray, "count 2"]:
    """Random points within an outline, from a fixed seed."""
    rng = np.random.default_rng(0)
    polygon = shapely.Polygon(outline)
    found = np.empty((0, 2))
    while len(found) < count:
        offered = rng.uniform(-0.5, 0.5, (2 * count, 2))
        found = np.concatenate([found, offered[shapely.contains_xy(polygon, offered)]])
    return found[:count]

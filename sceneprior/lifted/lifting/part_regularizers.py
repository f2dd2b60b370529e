"""Functions of parts and outlines alone: outlines of furniture seen from above, and the terms of
the loss on rays for volume, planes that contain faces, connected pieces, the gap to the floor or
the ceiling, and overhang (an object that has one tips over).

Faces lie on `LEVELS` + 1 evenly spaced levels between the sides of the object's box. Parts are cut
to the object's outline, so what lies outside it closes no gap and supports nothing.
"""

from typing import no_type_check

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from numba import njit

from sceneprior.core.parts import ACROSS_X, ACROSS_Z, BOX, CYLINDER, MOST_CORNERS, SQUARE

LEVELS = 64
"""Number of intervals between the levels on which faces lie."""
SMOOTHED = 0.3
"""Tolerance in cells of the simplification of outlines. Contours cut the corners of cells
diagonally, and with a larger tolerance these cuts would slant the sides of rectangles."""
FULL = 0.97
"""Share of the box's area above which an outline is replaced by the whole box."""


# no_type_check: the tests' type hook wraps every function, and Numba cannot compile a wrapper.
@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def volume_of(kind, mirrored, ends):
    """Volume of a part and its mirror images, as a share of the object's box."""
    copies = (2 if mirrored & ACROSS_X else 1) * (2 if mirrored & ACROSS_Z else 1)
    share = 1.0
    for axis in range(3):
        share *= (ends[axis, 1] - ends[axis, 0]) / LEVELS
    if kind == CYLINDER:
        share *= np.pi / 4
    elif kind != BOX:
        share *= np.pi / 6
    return copies * share


@njit(cache=True, nogil=True)
@no_type_check
def planes_of(ends, skipped):
    """True for the planes, by axis and level, that contain a face of any part but `skipped`, and
    across x and z for their mirror images. The sides of the box are always true."""
    used = np.zeros((3, LEVELS + 1), np.bool_)
    used[:, 0] = True
    used[:, LEVELS] = True
    for part in range(len(ends)):
        if part != skipped:
            for axis in range(3):
                for end in range(2):
                    used[axis, ends[part, axis, end]] = True
                    if axis != 1:
                        used[axis, LEVELS - ends[part, axis, end]] = True
    return used


@njit(cache=True, nogil=True)
@no_type_check
def count_planes(ends):
    """Number of planes that contain faces, without the sides of the box. Across x and z, a plane
    and its mirror image count once."""
    used = planes_of(ends, -1)
    return (
        used[1, 1:LEVELS].sum()
        + used[0, 1 : LEVELS // 2 + 1].sum()
        + used[2, 1 : LEVELS // 2 + 1].sum()
    )


@njit(cache=True, nogil=True)
@no_type_check
def solids_of(mirrored, ends, area):
    """Ends, in levels, of all parts and their mirror images that lie over the outline, whose area
    table is that of `outlines.area_table`."""
    solids = np.empty((4 * len(ends), 3, 2), np.int64)
    count = 0
    for part in range(len(ends)):
        for copy in range(4):
            if copy & ~mirrored[part]:
                continue
            solids[count] = ends[part]
            for bit, axis in ((ACROSS_X, 0), (ACROSS_Z, 2)):
                if copy & bit:
                    solids[count, axis, 0] = LEVELS - ends[part, axis, 1]
                    solids[count, axis, 1] = LEVELS - ends[part, axis, 0]
            x1, x2 = solids[count, 0]
            z1, z2 = solids[count, 2]
            count += area[x2, z2] - area[x1, z2] - area[x2, z1] + area[x1, z1] > 0
    return solids[:count]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def overhang(mirrored, ends, area):
    """Distance in levels, along x plus along z, from the rectangle around the lowest parts to the
    parts' centre of volume or to the middle of the box, whichever is further away. With the centre
    outside, an object tips over; with the middle outside, it stands on one side alone, as
    furniture hardly ever does."""
    solids = solids_of(mirrored, ends, area)
    if not len(solids):
        return 0.0
    lowest = solids[:, 1, 0].min()
    center, volume = np.zeros(3), 0.0
    low, high = np.full(3, float(LEVELS)), np.zeros(3)
    for solid in solids:
        share = 1.0
        for axis in range(3):
            share *= solid[axis, 1] - solid[axis, 0]
        volume += share
        for axis in range(3):
            center[axis] += share * (solid[axis, 0] + solid[axis, 1]) / 2
            if solid[1, 0] <= lowest + 1:
                low[axis] = min(low[axis], solid[axis, 0])
                high[axis] = max(high[axis], solid[axis, 1])
    beyond = 0.0
    for axis in (0, 2):
        apart = 0.0
        for middle in (center[axis] / volume, LEVELS / 2):
            apart = max(apart, low[axis] - middle, middle - high[axis])
        beyond += apart
    return beyond


@njit(cache=True, nogil=True)
@no_type_check
def gap_and_pieces(mirrored, ends, area, hangs):
    """Gap in levels between the largest connected piece and the bottom of the object's box (the
    top, if the object hangs), and the number of pieces. Parts at most one level apart are
    connected."""
    solids = solids_of(mirrored, ends, area)
    count = len(solids)
    piece = np.arange(count)
    pieces = count
    for one in range(count):
        for other in range(one):
            touch = True
            for axis in range(3):
                touch &= solids[one, axis, 0] <= solids[other, axis, 1] + 1
                touch &= solids[other, axis, 0] <= solids[one, axis, 1] + 1
            if touch and piece[one] != piece[other]:
                gone, pieces = piece[one], pieces - 1
                for each in range(count):
                    if piece[each] == gone:
                        piece[each] = piece[other]
    volume = np.zeros(count)
    for solid in range(count):
        sides = solids[solid, :, 1] - solids[solid, :, 0]
        volume[piece[solid]] += sides[0] * sides[1] * sides[2]
    gap = LEVELS
    for solid in range(count):
        if piece[solid] == volume.argmax():
            gap = min(gap, LEVELS - solids[solid, 1, 1] if hangs else solids[solid, 1, 0])
    return gap, pieces


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

"""Terms of the loss that depend on the parts alone: volume, number of planes that contain faces,
connected pieces, gap to the floor or the ceiling, and overhang (an object that has one tips over).

Faces lie on `LEVELS` + 1 evenly spaced levels between the sides of the object's box. Parts are cut
to the object's outline, so what lies outside it closes no gap and supports nothing.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from sceneprior.core.parts import ACROSS_X, ACROSS_Z, BOX, CYLINDER

LEVELS = 64
"""Number of intervals between the levels on which faces lie."""


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

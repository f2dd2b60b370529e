"""Intersections of rays with parts and outlines, and coordinate descent of the faces of parts.

Faces lie on `LEVELS` + 1 evenly spaced levels between the sides of the object's box, so that one
pass over the rays computes the costs of all levels of a face, exactly and in integers.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from sceneprior.core.parts import ACROSS_X, ACROSS_Z, BOWL, BOX, CYLINDER, DOME

LEVELS = 64
"""Number of intervals between the levels on which faces lie."""
FAR = 1e6
"""A level beyond all rays."""
NEVER = 1 << 20
"""Threshold of rays that miss the box at every level of the face."""
NEARBY = (0, -4, 4, -2, 2, -1, 1)
"""Steps in levels that are tried for a face of a curved part."""


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


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _meets_solid(start, span, kind, low, high):
    """True if a segment, from `start` to `start` + `span`, meets a solid."""
    near, far = 0.0, 1.0
    for axis in range(3):
        one = (low[axis] - start[axis]) / span[axis]
        other = (high[axis] - start[axis]) / span[axis]
        near, far = max(near, min(one, other)), min(far, max(one, other))
    if near > far:
        return False
    if kind == BOX:
        return True
    # |(start + t span - center) / radii|^2 <= 1, without y in a cylinder: a t^2 + 2 b t + c <= 0.
    a, b, c = 0.0, 0.0, -1.0
    for axis in range(3):
        if axis == 1 and kind == CYLINDER:
            continue
        center, radius = (low[axis] + high[axis]) / 2, (high[axis] - low[axis]) / 2
        if axis == 1 and kind == DOME:
            center, radius = low[1], 2 * radius
        elif axis == 1 and kind == BOWL:
            center, radius = high[1], 2 * radius
        offset, slope = (start[axis] - center) / radius, span[axis] / radius
        a += slope * slope
        b += slope * offset
        c += offset * offset
    # The minimum on [near, far].
    best = min(max(-b / a, near), far) if a > 1e-12 else near
    return a * best * best + 2 * b * best + c <= 0


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def meets(starts, spans, kind, mirrored, ends, met):
    """Set `met` to true for rays that meet a part or one of its mirror images. The ends, (3, 2),
    starts and spans are in levels."""
    low, high = ends[:, 0].astype(np.float64), ends[:, 1].astype(np.float64)
    start, span = np.empty(3), np.empty(3)
    for ray in range(len(met)):
        met[ray] = False
        for copy in range(4):
            if copy & ~mirrored:
                continue
            start[:] = starts[ray]
            span[:] = spans[ray]
            if copy & ACROSS_X:
                start[0], span[0] = LEVELS - start[0], -span[0]
            if copy & ACROSS_Z:
                start[2], span[2] = LEVELS - start[2], -span[2]
            if _meets_solid(start, span, kind, low, high):
                met[ray] = True
                break


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


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _face_costs(
    starts, inverse, hits, others, mirrored, ends, axis, upper, hit_price, miss_price, costs
):  # fmt: skip
    """Set `costs` to the price of wrong rays for each level of one face of a box, relative to a box
    that no ray meets.

    A ray meets the box if the face lies beyond a threshold: the first point along the axis at which
    the ray is between the other five faces. `inverse` are the reciprocals of the rays' spans.
    """
    costs[:] = 0
    low, high = ends[:, 0].astype(np.float64), ends[:, 1].astype(np.float64)
    if upper:
        high[axis] = FAR
    else:
        low[axis] = -FAR
    copies = 0
    lows, highs = np.empty((4, 3)), np.empty((4, 3))
    flips = np.empty(4, np.bool_)
    for copy in range(4):
        if copy & ~mirrored:
            continue
        lows[copies], highs[copies] = low, high
        if copy & ACROSS_X:
            lows[copies, 0], highs[copies, 0] = LEVELS - high[0], LEVELS - low[0]
        if copy & ACROSS_Z:
            lows[copies, 2], highs[copies, 2] = LEVELS - high[2], LEVELS - low[2]
        flips[copies] = (copy & ACROSS_X and axis == 0) or (copy & ACROSS_Z and axis == 2)
        copies += 1
    for ray in range(len(hits)):
        if others[ray] > 0:
            continue
        threshold = NEVER
        for copy in range(copies):
            near, far = 0.0, 1.0
            for side in range(3):
                one = (lows[copy, side] - starts[ray, side]) * inverse[ray, side]
                other = (highs[copy, side] - starts[ray, side]) * inverse[ray, side]
                near, far = max(near, min(one, other)), min(far, max(one, other))
            if near > far:
                continue
            start, span = starts[ray, axis], 1 / inverse[ray, axis]
            one, other = start + near * span, start + far * span
            if flips[copy]:
                one, other = LEVELS - one, LEVELS - other
            if upper:
                threshold = min(threshold, int(np.ceil(min(one, other))))
            else:
                threshold = min(threshold, LEVELS - int(np.floor(max(one, other))))
        if threshold <= LEVELS:
            place = max(threshold, 0) if upper else LEVELS - max(threshold, 0)
            costs[place] += -hit_price if hits[ray] else miss_price
    total = 0.0
    for step in range(LEVELS + 1):
        place = step if upper else LEVELS - step
        total += costs[place]
        costs[place] = total


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def descend(
    starts, spans, inverse, hits, kinds, mirrored, ends, covered, count, chosen, sweeps,
    hit_price, miss_price, volume_price, plane_price,
):  # fmt: skip
    """Move each face of the chosen parts, one after another, to its best level, in place.

    `covered` is true where a part meets a ray, and `count` is the number of parts that each ray
    meets; both are updated. The prices are those of a hit that no part meets, of a miss that one
    meets, of filling the whole box, and of a face in a new plane (`planes_of`). A box tries all
    levels of a face, a curved part only those nearby: its faces are not independent.
    """
    costs = np.zeros(LEVELS + 1)
    others = np.empty(len(hits), np.int16)
    met = np.empty(len(hits), np.bool_)
    for _ in range(sweeps):
        moved = False
        for part in chosen:
            for ray in range(len(hits)):
                others[ray] = count[ray] - covered[part, ray]
            kind, mirror, own = kinds[part], mirrored[part], ends[part]
            used = planes_of(ends, part)
            changed = False
            for face in range(6):
                axis, side = face // 2, face % 2
                before = best = own[axis, side]
                first, last = (own[axis, 0] + 1, LEVELS) if side else (0, own[axis, 1] - 1)
                if kind == BOX:
                    _face_costs(
                        starts, inverse, hits, others, mirror, own, axis, side == 1, hit_price,
                        miss_price, costs,
                    )  # fmt: skip
                least = np.inf
                # Ties: the current level first, then the first level tried.
                for trial in range(LEVELS + 2 if kind == BOX else len(NEARBY)):
                    if kind == BOX:
                        place = trial - 1 if trial else before
                    else:
                        place = before + NEARBY[trial]
                    if place < first or place > last:
                        continue
                    own[axis, side] = place
                    cost = volume_price * volume_of(kind, mirror, own)
                    if kind == BOX:
                        cost += costs[place]
                    if not used[axis, place]:
                        cost += plane_price
                    if kind != BOX:
                        meets(starts, spans, kind, mirror, own, met)
                        for ray in range(len(hits)):
                            if others[ray] == 0:
                                if met[ray] and not hits[ray]:
                                    cost += miss_price
                                elif hits[ray] and not met[ray]:
                                    cost += hit_price
                    if cost < least - 1e-12:
                        least, best = cost, place
                own[axis, side] = best
                changed |= best != before
            if changed:
                moved = True
                meets(starts, spans, kind, mirror, own, covered[part])
                for ray in range(len(hits)):
                    count[ray] = others[ray] + covered[part, ray]
        if not moved:
            break


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def count_wrong(
    starts, spans, hits, kinds, lows, highs, first_solids, corners, first_corners, most, wrong
):  # fmt: skip
    """Set `wrong` to the number of rays that each of several objects explains wrongly; counting of
    object i stops at a number above `most[i]`.

    Object i is the union of the solids `first_solids[i]` to `first_solids[i + 1]`, cut to the
    outline of the corners `first_corners[i]` to `first_corners[i + 1]` (one past the last). Rays,
    solids and corners have the same units; rays without a span are skipped.
    """
    wrong[:] = 0
    start, span = np.empty(3), np.empty(3)
    for ray in range(len(hits)):
        if spans[ray, 0] == 0 and spans[ray, 1] == 0 and spans[ray, 2] == 0:
            continue
        for item in range(len(wrong)):
            if wrong[item] > most[item]:
                continue
            outline = corners[first_corners[item] : first_corners[item + 1]]
            near, far = within(starts[ray], spans[ray], outline)
            met = False
            if near <= far:
                for axis in range(3):
                    start[axis] = starts[ray, axis] + near * spans[ray, axis]
                    span[axis] = (far - near) * spans[ray, axis]
                for solid in range(first_solids[item], first_solids[item + 1]):
                    if _meets_solid(start, span, kinds[solid], lows[solid], highs[solid]):
                        met = True
                        break
            wrong[item] += met != hits[ray]

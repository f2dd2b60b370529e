"""The exact mode on the CPU: the formula over every face near a pixel.

Buffers hold, for each pixel of each window (kernels.py),

    odds  P = prod_f (1 + exp(x_f)), x_f = +-d_f / sigma, so that coverage = 1 - 1 / P, and
    order the depth order (larger is nearer): 1 / z of the nearest face that contains the pixel
          centre, else -z of the nearest face whose blur reaches it, else -inf.

The loops over a strip's pixels contain only arithmetic, without branches or calls, so LLVM
vectorises them to 8 or 16 pixels at a time. Meshes are independent, and each is handled by one
thread, so the result does not depend on the number of threads.
"""

from typing import Any

import numpy as np
from numba import njit

from sceneprior.render.silhouettes.cpu.kernels import in_threads, pixel_range, vector_exp
from sceneprior.render.silhouettes.reference import MIN_AREA_PX2, SLACK

_LOOSE: Any = {"contract", "reassoc", "nsz", "arcp"}
"""LLVM flags that allow reordered, fused and vectorised sums, but keep infinities intact."""


@njit(inline="always")
def _from_edge(px, py, ax, ay, bx, by, over_length2, zero, one):
    """Vector to p from the nearest point of edge ab, that point's parameter on ab, and twice the
    signed area of triangle (a, b, p)."""
    ux, uy, x, y = bx - ax, by - ay, px - ax, py - ay
    t = min(max((x * ux + y * uy) * over_length2, zero), one)
    return x - t * ux, y - t * uy, t, ux * y - uy * x


@njit(inline="always")
def _at_pixel(k, column, row, face, T):
    """Vectors to a strip's k-th pixel from the nearest point of each edge, the parameters of these
    points, and the barycentric weights of the pixel."""
    ax, ay, bx, by, cx, cy, over_area, over1, over2, over3 = face
    zero, one = T(0), T(1)
    px = T(column + (np.int32(k) & 7)) + T(0.5)
    py = T(row + (np.int32(k) >> 3)) + T(0.5)
    x1, y1, t1, wc = _from_edge(px, py, ax, ay, bx, by, over1, zero, one)
    x2, y2, t2, wa = _from_edge(px, py, bx, by, cx, cy, over2, zero, one)
    x3, y3, t3, _ = _from_edge(px, py, cx, cy, ax, ay, over3, zero, one)
    wa, wc = wa * over_area, wc * over_area
    return x1, y1, t1, x2, y2, t2, x3, y3, t3, wa, one - wa - wc, wc


@njit(fastmath=_LOOSE, error_model="numpy", nogil=True)
def _draw_strip(odds, order, start, count, column, row, face, nearness, over_sigma, blur):
    T = odds.dtype.type
    zero, one, most, slack = T(0), T(1), T(80), T(-SLACK)
    for k in range(count):
        j = np.uintp(start) + np.uintp(k)  # unsigned: checks for < 0 would stop vectorisation
        x1, y1, _, x2, y2, _, x3, y3, _, wa, wb, wc = _at_pixel(k, column, row, face, T)
        d = min(x1 * x1 + y1 * y1, min(x2 * x2 + y2 * y2, x3 * x3 + y3 * y3))
        inside = min(wa, min(wb, wc)) > zero
        touched = inside | (d < blur)
        x = min(d * over_sigma, most)
        odds[j] *= one + vector_exp(x if inside else -x) if touched else one
        contained = min(wa, min(wb, wc)) > slack
        wa, wb, wc = max(wa, zero), max(wb, zero), max(wc, zero)
        near = wa * nearness[0] + wb * nearness[1] + wc * nearness[2]
        here = near if contained else -(wa + wb + wc) / near
        order[j] = max(order[j], here if touched | contained else T(-np.inf))


@njit(fastmath=_LOOSE, error_model="numpy", nogil=True)
def _strip_gradient(upstream, start, count, column, row, face, over_sigma, blur):
    """Contribution of a strip's pixels to the gradient of a face's three corners, times -1/2."""
    T = upstream.dtype.type
    zero, one, most = T(0), T(1), T(80)
    gax, gay, gbx, gby, gcx, gcy = zero, zero, zero, zero, zero, zero
    for k in range(count):
        j = np.uintp(start) + np.uintp(k)
        x1, y1, t1, x2, y2, t2, x3, y3, t3, wa, wb, wc = _at_pixel(k, column, row, face, T)
        d1, d2, d3 = x1 * x1 + y1 * y1, x2 * x2 + y2 * y2, x3 * x3 + y3 * y3
        d = min(d1, min(d2, d3))
        inside = min(wa, min(wb, wc)) > zero
        touched = inside | (d < blur)
        x = min(d * over_sigma, most)
        x = x if inside else -x
        # dcoverage/dx = (1 - coverage) * sigmoid(x); upstream includes the first factor.
        weight = upstream[j] * over_sigma / (one + vector_exp(-x))
        weight = weight if inside else -weight
        weight = weight if touched else zero
        first = (d1 <= d2) & (d1 <= d3)
        third = (d2 > d3) & (d1 > d3)
        # d depends on the corners through the nearest point, which interpolates its edge's ends.
        m1 = weight if first else zero
        m3 = weight if third else zero
        m2 = weight - m1 - m3
        gx, gy = m1 * x1, m1 * y1
        gax += (one - t1) * gx
        gay += (one - t1) * gy
        gbx += t1 * gx
        gby += t1 * gy
        gx, gy = m2 * x2, m2 * y2
        gbx += (one - t2) * gx
        gby += (one - t2) * gy
        gcx += t2 * gx
        gcy += t2 * gy
        gx, gy = m3 * x3, m3 * y3
        gcx += (one - t3) * gx
        gcy += (one - t3) * gy
        gax += t3 * gx
        gay += t3 * gy
    return gax, gay, gbx, gby, gcx, gcy


@njit(inline="always")
def _over_length2(ax, ay, bx, by, one, least):
    return one / max((bx - ax) * (bx - ax) + (by - ay) * (by - ay), least)


@njit(inline="always")
def _region(pixels, depths, corners, bounds, reach, near, T):
    """Rows and strips of the window that a face reaches (none if it is not drawn), and its corners
    with precomputed inverses."""
    ia, ib, ic = corners
    one, least = T(1), T(MIN_AREA_PX2)
    za, zb, zc = depths[ia], depths[ib], depths[ic]
    ax, ay, bx, by = pixels[ia, 0], pixels[ia, 1], pixels[ib, 0], pixels[ib, 1]
    cx, cy = pixels[ic, 0], pixels[ic, 1]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    face = (
        ax, ay, bx, by, cx, cy, one / area, _over_length2(ax, ay, bx, by, one, least),
        _over_length2(bx, by, cx, cy, one, least), _over_length2(cx, cy, ax, ay, one, least),
    )  # fmt: skip
    if za <= near or zb <= near or zc <= near or abs(area) <= least:
        return 0, 0, 0, 0, face
    top, bottom = pixel_range(min(ay, by, cy) - reach, max(ay, by, cy) + reach, bounds[1])
    left, right = pixel_range(min(ax, bx, cx) - reach, max(ax, bx, cx) + reach, bounds[3] * 8)
    top = max(top, bounds[0])
    strip1 = (right + 7) >> 3 if top < bottom else 0
    return top, bottom, max(left >> 3, bounds[2]), strip1, face


@njit(cache=True, nogil=True, error_model="numpy")
def _cover(first, last, pixels, depths, faces, bounds, starts, sigma, blur, near, odds, order):
    """Fill `odds` (initially 1) and `order` (initially -inf) of all windows."""
    T = pixels.dtype.type
    one, over_sigma, blur_, reach = T(1), T(1 / sigma), T(blur), np.sqrt(blur)
    for mesh in range(first, last):
        rows = bounds[mesh, 1] - bounds[mesh, 0]
        for f in range(faces.shape[0] if rows > 0 else 0):
            corners = faces[f, 0], faces[f, 1], faces[f, 2]
            top, bottom, strip0, strip1, face = _region(
                pixels[mesh], depths[mesh], corners, bounds[mesh], reach, near, T
            )
            nearness = (
                one / depths[mesh, corners[0]],
                one / depths[mesh, corners[1]],
                one / depths[mesh, corners[2]],
            )
            for strip in range(strip0, strip1):
                start = ((strip - bounds[mesh, 2]) * rows + top - bounds[mesh, 0]) * 8
                _draw_strip(
                    odds, order, starts[mesh] + start, (bottom - top) * 8, np.int32(strip * 8),
                    np.int32(top), face, nearness, over_sigma, blur_,
                )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _cover_backward(
    first, last, pixels, depths, faces, bounds, starts, sigma, blur, near, upstream, gradient
):
    """Add dL/dpixels to `gradient`, from `upstream` = -dL/dlog(missed)."""
    T = pixels.dtype.type
    two, over_sigma, blur_, reach = T(2), T(1 / sigma), T(blur), np.sqrt(blur)
    for mesh in range(first, last):
        rows = bounds[mesh, 1] - bounds[mesh, 0]
        for f in range(faces.shape[0] if rows > 0 else 0):
            corners = faces[f, 0], faces[f, 1], faces[f, 2]
            top, bottom, strip0, strip1, face = _region(
                pixels[mesh], depths[mesh], corners, bounds[mesh], reach, near, T
            )
            for strip in range(strip0, strip1):
                start = ((strip - bounds[mesh, 2]) * rows + top - bounds[mesh, 0]) * 8
                by_corner = _strip_gradient(
                    upstream, starts[mesh] + start, (bottom - top) * 8, np.int32(strip * 8),
                    np.int32(top), face, over_sigma, blur_,
                )  # fmt: skip
                for corner in range(3):
                    gradient[mesh, corners[corner], 0] -= two * by_corner[2 * corner]
                    gradient[mesh, corners[corner], 1] -= two * by_corner[2 * corner + 1]


def cover(pixels, depths, faces, windows, settings):
    """Odds and orders of all windows; the backward pass needs nothing else."""
    odds = np.ones(windows.start[-1], dtype=pixels.dtype)
    order = np.full(windows.start[-1], -np.inf, dtype=pixels.dtype)
    rest = (settings.sigma_px2, settings.blur_px2, settings.near_m)
    in_threads(_cover, len(pixels), pixels, depths, faces, *windows, *rest, odds, order)
    return odds, order, None


def cover_backward(pixels, depths, faces, windows, settings, odds, traced, upstream):
    """dL/dpixels from `upstream` = -dL/dlog(missed)."""
    gradient = np.zeros_like(pixels)
    rest = (settings.sigma_px2, settings.blur_px2, settings.near_m, upstream, gradient)
    in_threads(_cover_backward, len(pixels), pixels, depths, faces, *windows, *rest)
    return gradient

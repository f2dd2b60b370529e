"""The fast mode on the CPU: each mesh's outline is extracted once, and only the outline is soft.

The silhouette of a mesh is treated as one shape instead of many faces:

    coverage = sigmoid(+-d / sigma), d the squared distance to the nearest point of its outline,

with + if a face contains the pixel centre. Candidates for the outline are the edges across which
the number of faces that cover an image point changes (in a closed mesh, edges between a front and a
back face). The outline consists of the parts of these edges beyond which no face lies. Faces are
rasterised hard, so the cost grows with pixels and outline length, not with faces times blur.
docs/silhouettes.md shows the difference from the exact formula.
"""

import numpy as np
from numba import njit

from sceneprior.render.silhouettes.cpu.kernels import in_threads, pixel_range
from sceneprior.render.silhouettes.reference import (
    ASIDE_PX,
    MIN_AREA_PX2,
    PIECE_PX,
    SLACK,
    topology_of,
)


@njit(error_model="numpy", nogil=True)
def _depth_strip(
    order, start, count, column, row, ax, ay, over_area, bx, by, cx, cy, near_a, near_b, near_c
):  # fmt: skip
    """Maximum of `order` and a face's 1 / z at pixel centres inside it; vectorised (faces.py)."""
    T = order.dtype.type
    half, least, most, nowhere = T(0.5), T(-SLACK), T(1 + SLACK), T(-np.inf)
    for k in range(count):
        j = np.uintp(start) + np.uintp(k)
        x = T(column + (np.int32(k) & 7)) + half - ax
        y = T(row + (np.int32(k) >> 3)) + half - ay
        wb = (x * cy - y * cx) * over_area
        wc = (y * bx - x * by) * over_area
        here = near_a + wb * near_b + wc * near_c
        contained = (wb > least) & (wc > least) & (wb + wc < most)
        order[j] = max(order[j], here if contained else nowhere)


@njit(nogil=True, error_model="numpy")
def _rasterize(
    points, nearness, faces, edge_of, way, row0, row1, strip0, strip1, start, most, order, layers
):  # fmt: skip
    """Write 1 / depth of the nearest face at pixel centres to `order`, and the number of faces to
    the left of each edge, minus those to its right, to `layers`."""
    T = points.dtype.type
    one, least, inner, outer = T(1), T(MIN_AREA_PX2), T(0.499), T(0.501)
    low_row, high_row = T(row0), T(row1)
    low_column, high_column = T(strip0 * 8), T(strip1 * 8)
    for f in range(faces.shape[0]):
        ia, ib, ic = faces[f, 0], faces[f, 1], faces[f, 2]
        near_a, near_b, near_c = nearness[ia], nearness[ib], nearness[ic]
        if not (0 < near_a < most and 0 < near_b < most and 0 < near_c < most):
            continue
        ax, ay = points[ia, 0], points[ia, 1]
        bx, by = points[ib, 0], points[ib, 1]
        cx, cy = points[ic, 0], points[ic, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) <= least:
            continue
        side = 1 if area > 0 else -1
        layers[edge_of[f, 0]] += side * way[f, 0]
        layers[edge_of[f, 1]] += side * way[f, 1]
        layers[edge_of[f, 2]] += side * way[f, 2]
        # The range of pixel centres, widened a little; for most small faces it is empty.
        top = int(max(min(ay, by, cy) + inner, low_row))
        bottom = int(min(max(ay, by, cy) + outer, high_row))
        left = int(max(min(ax, bx, cx) + inner, low_column))
        right = int(min(max(ax, bx, cx) + outer, high_column))
        if top >= bottom or left >= right:
            continue
        left, right = left >> 3, (right + 7) >> 3
        for strip in range(left, right):
            _depth_strip(
                order, start + ((strip - strip0) * (row1 - row0) + top - row0) * 8,
                (bottom - top) * 8, np.int32(strip * 8), np.int32(top), ax, ay, one / area,
                bx - ax, by - ay, cx - ax, cy - ay, near_a, near_b - near_a, near_c - near_a,
            )  # fmt: skip


@njit(nogil=True, error_model="numpy")
def _faces_over(x, y, ax, ay, by, slope, falls):
    """Number of faces over a point, summed over the edges to its right; vectorised."""
    faces = 0
    for i in range(ax.size):
        crossed = (ay[i] <= y) != (by[i] <= y)
        right = ax[i] + (y - ay[i]) * slope[i] > x  # NaN on a level edge, which is never crossed
        faces += falls[i] if crossed & right else 0
    return faces


@njit(inline="always")
def _cut(start, step, low, high, first, last):
    """Clip the range [first, last] of t to low <= start + t * step <= high."""
    if step == 0.0:
        return (first, last) if low <= start <= high else (1.0, 0.0)
    t0, t1 = (low - start) / step, (high - start) / step
    return max(first, min(t0, t1)), min(last, max(t0, t1))


@njit(nogil=True, error_model="numpy")
def _candidates(points, edges, layers):
    """Edges across which the number of faces changes: their indices, ends and dx / dy, and the
    decrease in the number of faces when crossing to the right along a row."""
    which = np.flatnonzero(layers).astype(np.int32)
    ax, ay, bx, by = np.empty((4, which.size))
    for i in range(which.size):
        a, b = edges[which[i], 0], edges[which[i], 1]
        ax[i], ay[i], bx[i], by[i] = points[a, 0], points[a, 1], points[b, 0], points[b, 1]
    # An edge that runs down the image (y grows) is crossed from its left side by a row.
    falls = np.where(by > ay, layers[which], -layers[which])
    return which, ax, ay, bx, by, (bx - ax) / (by - ay), falls


@njit(nogil=True, error_model="numpy")
def _trace(
    candidates, layers, row0, row1, strip0, strip1, start, blur, distance, edge, share
):  # fmt: skip
    """Write the squared distance to the outline, the nearest edge, and the parameter of the nearest
    point on that edge, for pixels near the outline."""
    rows = row1 - row0
    reach = np.sqrt(blur)
    which, all_ax, all_ay, all_bx, all_by, slope, falls = candidates
    for i in range(which.size):
        ax, ay = all_ax[i], all_ay[i]
        ux, uy = all_bx[i] - ax, all_by[i] - ay
        length = np.sqrt(ux * ux + uy * uy)
        over_length2 = 1.0 / (length * length)
        # The side with fewer faces: opposite to the left, (-uy, ux), for positive layers.
        away = -ASIDE_PX / length if layers[which[i]] > 0 else ASIDE_PX / length
        t0, t1 = _cut(ax, ux, strip0 * 8 - reach, strip1 * 8 + reach, 0.0, 1.0)
        t0, t1 = _cut(ay, uy, row0 - reach, row1 + reach, t0, t1)
        if not (t0 < t1 and length < np.inf):
            continue
        pieces = np.ceil(length / PIECE_PX)
        for piece in range(int(np.floor(t0 * pieces)), int(np.ceil(t1 * pieces))):
            t0, t1 = piece / pieces, (piece + 1) / pieces
            middle = (t0 + t1) / 2
            x, y = ax + middle * ux - away * uy, ay + middle * uy + away * ux
            if _faces_over(x, y, all_ax, all_ay, all_by, slope, falls) > 0:
                continue
            x0, x1, y0, y1 = ax + t0 * ux, ax + t1 * ux, ay + t0 * uy, ay + t1 * uy
            top, bottom = pixel_range(min(y0, y1) - reach, max(y0, y1) + reach, row1)
            left, right = pixel_range(min(x0, x1) - reach, max(x0, x1) + reach, strip1 * 8)
            for row in range(max(top, row0), bottom):
                y = row + 0.5 - ay
                for column in range(max(left, strip0 * 8), right):
                    x = column + 0.5 - ax
                    t = min(max((x * ux + y * uy) * over_length2, t0), t1)
                    d = (x - t * ux) * (x - t * ux) + (y - t * uy) * (y - t * uy)
                    j = start + (((column >> 3) - strip0) * rows + row - row0) * 8 + (column & 7)
                    if d < distance[j]:
                        distance[j], edge[j], share[j] = d, which[i], t


@njit(cache=True, nogil=True, error_model="numpy")
def _cover(
    first, last, pixels, nearness, faces, edges, edge_of, way, bounds, starts, sigma, blur, most,
    odds, order, edge, share,
):  # fmt: skip
    for mesh in range(first, last):
        row0, row1, strip0, strip1 = bounds[mesh]
        if row1 <= row0:
            continue
        points, z, start = pixels[mesh], nearness[mesh], starts[mesh]
        layers = np.zeros(edges.shape[0], dtype=np.int32)
        _rasterize(
            points, z, faces, edge_of, way, row0, row1, strip0, strip1, start, most, order, layers
        )
        for j in range(start, starts[mesh + 1]):
            odds[j] = blur  # temporarily holds squared distances
        _trace(
            _candidates(points, edges, layers), layers, row0, row1, strip0, strip1, start, blur,
            odds, edge, share,
        )  # fmt: skip
        for j in range(start, starts[mesh + 1]):
            inside = order[j] > 0.0
            if edge[j] < 0:
                odds[j] = np.inf if inside else 1.0
                continue
            odds[j] = 1.0 + np.exp((odds[j] if inside else -odds[j]) / sigma)
            if not inside:
                a, b = edges[edge[j], 0], edges[edge[j], 1]
                order[j] = -1.0 / ((1.0 - share[j]) * z[a] + share[j] * z[b])


@njit(cache=True, nogil=True, error_model="numpy")
def _cover_backward(
    first, last, pixels, edges, bounds, starts, sigma, odds, order, edge, share, upstream, gradient
):  # fmt: skip
    for mesh in range(first, last):
        row0, row1, strip0, strip1 = bounds[mesh]
        j = starts[mesh]
        for strip in range(strip0, strip1 if row1 > row0 else strip0):
            for row in range(row0, row1):
                for column in range(strip * 8, strip * 8 + 8):
                    if edge[j] >= 0 and upstream[j] != 0.0:
                        a, b, t = edges[edge[j], 0], edges[edge[j], 1], float(share[j])
                        ax, ay = float(pixels[mesh, a, 0]), float(pixels[mesh, a, 1])
                        x = column + 0.5 - ax - t * (pixels[mesh, b, 0] - ax)
                        y = row + 0.5 - ay - t * (pixels[mesh, b, 1] - ay)
                        # sigmoid(x) = 1 - 1 / odds; d depends on the ends via the nearest point.
                        weight = -2.0 * upstream[j] * (1.0 - 1.0 / odds[j]) / sigma
                        weight = weight if order[j] > 0.0 else -weight
                        gradient[mesh, a, 0] += (1.0 - t) * weight * x
                        gradient[mesh, a, 1] += (1.0 - t) * weight * y
                        gradient[mesh, b, 0] += t * weight * x
                        gradient[mesh, b, 1] += t * weight * y
                    j += 1


def cover(pixels, depths, faces, windows, settings):
    """Odds P (coverage = 1 - 1 / P) and orders (1 / depth) at the pixels of all windows, and the
    nearest outline point of each pixel."""
    mesh = topology_of(faces)
    size = windows.start[-1]
    odds = np.empty(size, dtype=pixels.dtype)
    order = np.full(size, -np.inf, dtype=pixels.dtype)
    edge = np.full(size, -1, dtype=np.int32)
    share = np.empty(size, dtype=pixels.dtype)
    with np.errstate(divide="ignore"):
        nearness = 1 / depths
    rest = (settings.sigma_px2, settings.blur_px2, 1 / settings.near_m)
    results = (odds, order, edge, share)
    in_threads(_cover, len(pixels), pixels, nearness, faces, *mesh, *windows, *rest, *results)
    return odds, order, (mesh.edges, order, edge, share)


def cover_backward(pixels, depths, faces, windows, settings, odds, traced, upstream):
    """dL/dpixels from `upstream` = -dL/dlog(missed)."""
    edges, order, edge, share = traced
    gradient = np.zeros_like(pixels)
    rest = (settings.sigma_px2, odds, order, edge, share, upstream, gradient)
    in_threads(_cover_backward, len(pixels), pixels, edges, *windows, *rest)
    return gradient

"""The fast mode on the CPU: a mesh's outline is found once, and only it is soft.

The silhouette of a mesh is taken as one shape instead of many faces:

    coverage = sigmoid(+-d / sigma), d the squared distance to the nearest point of its outline,

+ where a face contains the pixel centre. The outline is made of edges at which the number of
faces over a point of the image changes (for a closed mesh: one face turned towards the camera,
one away), as far as no other face lies on their far side. Faces are only rasterised hard, so the
cost grows with pixels and outline length, not with faces times blur. docs/silhouettes.md draws
how this differs from the exact formula. All arithmetic is in float64.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from sceneprior.silhouettes.reference import ASIDE_PX, MIN_AREA_PX2, PIECE_PX, SLACK
from sceneprior.silhouettes.threads import in_threads
from sceneprior.silhouettes.topology import topology_of
from sceneprior.silhouettes.windows import pixel_range


# no_type_check: the tests' type hook wraps every function, and Numba cannot compile a wrapper.
@njit(nogil=True, error_model="numpy")
@no_type_check
def _rasterize(
    points, depths, faces, edge_of, way, row0, row1, strip0, strip1, start, near, order, layers
):  # fmt: skip
    """Depths of faces at pixel centres, and for each edge how many faces more lie to its left."""
    rows = row1 - row0
    for f in range(faces.shape[0]):
        ia, ib, ic = faces[f, 0], faces[f, 1], faces[f, 2]
        za, zb, zc = float(depths[ia]), float(depths[ib]), float(depths[ic])
        if za <= near or zb <= near or zc <= near:
            continue
        ax, ay = float(points[ia, 0]), float(points[ia, 1])
        bx, by = float(points[ib, 0]), float(points[ib, 1])
        cx, cy = float(points[ic, 0]), float(points[ic, 1])
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) <= MIN_AREA_PX2:
            continue
        side = 1 if area > 0.0 else -1
        layers[edge_of[f, 0]] += side * way[f, 0]
        layers[edge_of[f, 1]] += side * way[f, 1]
        layers[edge_of[f, 2]] += side * way[f, 2]
        top, bottom = pixel_range(min(ay, by, cy), max(ay, by, cy), row1)
        left, right = pixel_range(min(ax, bx, cx), max(ax, bx, cx), strip1 * 8)
        top, left = max(top, row0), max(left, strip0 * 8)
        if top >= bottom or left >= right:
            continue
        over = 1.0 / area
        near_a, near_b, near_c = 1.0 / za, 1.0 / zb, 1.0 / zc
        for row in range(top, bottom):
            y = row + 0.5 - ay
            for column in range(left, right):
                x = column + 0.5 - ax
                wb = (x * (cy - ay) - y * (cx - ax)) * over
                wc = (y * (bx - ax) - x * (by - ay)) * over
                if wb > -SLACK and wc > -SLACK and wb + wc < 1.0 + SLACK:
                    nearness = near_a + wb * (near_b - near_a) + wc * (near_c - near_a)
                    j = start + (((column >> 3) - strip0) * rows + row - row0) * 8 + (column & 7)
                    if nearness > order[j]:
                        order[j] = nearness


@njit(nogil=True, error_model="numpy")
@no_type_check
def _faces_over(x, y, ends, layers, count):
    """Number of faces over a point: what the edges to its right add up to."""
    faces = 0
    for i in range(count):
        ax, ay, bx, by = ends[i, 0], ends[i, 1], ends[i, 2], ends[i, 3]
        if (ay <= y) != (by <= y) and ax + (y - ay) * (bx - ax) / (by - ay) > x:
            # Going right, an edge that runs down the image is crossed from its left side.
            faces += layers[i] if by > ay else -layers[i]
    return faces


@njit(inline="always")
@no_type_check
def _cut(start, step, low, high, first, last):
    """The part [first, last] of a line, low <= start + t * step <= high."""
    if step == 0.0:
        return (first, last) if low <= start <= high else (1.0, 0.0)
    t0, t1 = (low - start) / step, (high - start) / step
    return max(first, min(t0, t1)), min(last, max(t0, t1))


@njit(nogil=True, error_model="numpy")
@no_type_check
def _trace(
    ends, layers, which, count, row0, row1, strip0, strip1, start, blur, distance, edge, share
):  # fmt: skip
    """Squared distance to the outline, its nearest edge, and where on it, near the outline."""
    rows = row1 - row0
    reach = np.sqrt(blur)
    for i in range(count):
        ax, ay = ends[i, 0], ends[i, 1]
        ux, uy = ends[i, 2] - ax, ends[i, 3] - ay
        length = np.hypot(ux, uy)
        # The side with fewer faces: away from the left, (-uy, ux), where layers are positive.
        away = -ASIDE_PX / length if layers[i] > 0 else ASIDE_PX / length
        t0, t1 = _cut(ax, ux, strip0 * 8 - reach, strip1 * 8 + reach, 0.0, 1.0)
        t0, t1 = _cut(ay, uy, row0 - reach, row1 + reach, t0, t1)
        if not (t0 < t1 and length < np.inf):
            continue
        pieces = np.ceil(length / PIECE_PX)
        for piece in range(int(np.floor(t0 * pieces)), int(np.ceil(t1 * pieces))):
            t0, t1 = piece / pieces, (piece + 1) / pieces
            middle = (t0 + t1) / 2
            x, y = ax + middle * ux - away * uy, ay + middle * uy + away * ux
            if _faces_over(x, y, ends, layers, count) > 0:
                continue
            x0, x1, y0, y1 = ax + t0 * ux, ax + t1 * ux, ay + t0 * uy, ay + t1 * uy
            top, bottom = pixel_range(min(y0, y1) - reach, max(y0, y1) + reach, row1)
            left, right = pixel_range(min(x0, x1) - reach, max(x0, x1) + reach, strip1 * 8)
            for row in range(max(top, row0), bottom):
                y = row + 0.5 - ay
                for column in range(max(left, strip0 * 8), right):
                    x = column + 0.5 - ax
                    t = min(max((x * ux + y * uy) / (length * length), t0), t1)
                    d = (x - t * ux) * (x - t * ux) + (y - t * uy) * (y - t * uy)
                    j = start + (((column >> 3) - strip0) * rows + row - row0) * 8 + (column & 7)
                    if d < distance[j]:
                        distance[j], edge[j], share[j] = d, which[i], t


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _cover(
    first, last, pixels, depths, faces, edges, edge_of, way, bounds, starts, sigma, blur, near,
    odds, order, edge, share,
):  # fmt: skip
    for mesh in range(first, last):
        row0, row1, strip0, strip1 = bounds[mesh]
        if row1 <= row0:
            continue
        points, z, start = pixels[mesh], depths[mesh], starts[mesh]
        all_layers = np.zeros(edges.shape[0], dtype=np.int32)
        _rasterize(
            points, z, faces, edge_of, way, row0, row1, strip0, strip1, start, near,
            order, all_layers,
        )  # fmt: skip
        count = 0
        for e in range(edges.shape[0]):
            count += all_layers[e] != 0
        which = np.empty(count, dtype=np.int32)
        layers = np.empty(count, dtype=np.int32)
        ends = np.empty((count, 4))
        count = 0
        for e in range(edges.shape[0]):
            a, b = edges[e, 0], edges[e, 1]
            if all_layers[e] != 0:
                which[count], layers[count] = e, all_layers[e]
                ends[count, 0], ends[count, 1] = points[a, 0], points[a, 1]
                ends[count, 2], ends[count, 3] = points[b, 0], points[b, 1]
                count += 1
        for j in range(start, starts[mesh + 1]):
            odds[j] = blur  # holds squared distances for now
        _trace(
            ends, layers, which, count, row0, row1, strip0, strip1, start, blur, odds, edge, share
        )
        for j in range(start, starts[mesh + 1]):
            inside = order[j] > 0.0
            if edge[j] < 0:
                odds[j] = np.inf if inside else 1.0
                continue
            odds[j] = 1.0 + np.exp((odds[j] if inside else -odds[j]) / sigma)
            if not inside:
                a, b = edges[edge[j], 0], edges[edge[j], 1]
                order[j] = -1.0 / ((1.0 - share[j]) / z[a] + share[j] / z[b])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _pull_back(
    first, last, pixels, edges, bounds, starts, sigma, odds, order, edge, share, force, gradient
):  # fmt: skip
    for mesh in range(first, last):
        row0, row1, strip0, strip1 = bounds[mesh]
        j = starts[mesh]
        for strip in range(strip0, strip1 if row1 > row0 else strip0):
            for row in range(row0, row1):
                for column in range(strip * 8, strip * 8 + 8):
                    if edge[j] >= 0 and force[j] != 0.0:
                        a, b, t = edges[edge[j], 0], edges[edge[j], 1], float(share[j])
                        ax, ay = float(pixels[mesh, a, 0]), float(pixels[mesh, a, 1])
                        x = column + 0.5 - ax - t * (pixels[mesh, b, 0] - ax)
                        y = row + 0.5 - ay - t * (pixels[mesh, b, 1] - ay)
                        # sigmoid(x) = 1 - 1 / odds; moving the nearest point changes d.
                        weight = -2.0 * force[j] * (1.0 - 1.0 / odds[j]) / sigma
                        weight = weight if order[j] > 0.0 else -weight
                        gradient[mesh, a, 0] += (1.0 - t) * weight * x
                        gradient[mesh, a, 1] += (1.0 - t) * weight * y
                        gradient[mesh, b, 0] += t * weight * x
                        gradient[mesh, b, 1] += t * weight * y
                    j += 1


def cover(pixels, depths, faces, windows, settings):
    """Odds and orders of all windows, and where their outlines run."""
    mesh = topology_of(faces)
    size = windows.start[-1]
    odds = np.empty(size, dtype=pixels.dtype)
    order = np.full(size, -np.inf, dtype=pixels.dtype)
    edge = np.full(size, -1, dtype=np.int32)
    share = np.empty(size, dtype=pixels.dtype)
    rest = (settings.sigma_px2, settings.blur_px2, settings.near_m)
    in_threads(
        _cover, len(pixels), pixels, depths, faces, *mesh, *windows, *rest, odds, order, edge, share
    )
    return odds, order, (mesh.edges, order, edge, share)


def pull_back(pixels, depths, faces, windows, settings, odds, traced, force):
    """dL/dpixels."""
    edges, order, edge, share = traced
    gradient = np.zeros_like(pixels)
    rest = (settings.sigma_px2, odds, order, edge, share, force, gradient)
    in_threads(_pull_back, len(pixels), pixels, edges, *windows, *rest)
    return gradient

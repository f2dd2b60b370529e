"""Projected triangles in, soft coverage and its gradient out: the Numba backend.

Forward and backward are loops over the pixels around each face. A pixel deep inside a mesh is
covered for certain: it adds nothing to the gradient and is passed over there, so backward cost
grows with the outline. Meshes are independent, so the result does not depend on the threads.
"""

import os
from typing import no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import njit, prange
from torch import Tensor

if "NUMBA_THREADING_LAYER" not in os.environ:
    # Numba's OpenMP layer shares its threads with torch and sets torch's number of threads back
    # to all cores, which stalls a small network where another program holds one of them.
    numba.config.THREADING_LAYER = "workqueue"  # type: ignore[attr-defined]

CERTAIN = 18.0
"""-log of the chance to miss past which a pixel counts as covered: 1 - exp(-18) is 1 in float32."""


# no_type_check: the tests' type hook wraps every function, and Numba cannot compile a wrapper.
@njit(inline="always", fastmath=False)
@no_type_check
def _nearest_on_edge(px, py, ax, ay, bx, by):  # pragma: no cover - compiled
    """Squared distance from p to segment ab, and where on it (0 at a, 1 at b)."""
    ex, ey = bx - ax, by - ay
    length2 = ex * ex + ey * ey
    t = ((px - ax) * ex + (py - ay) * ey) / max(length2, 1e-12)
    t = min(max(t, 0.0), 1.0)
    dx, dy = px - (ax + t * ex), py - (ay + t * ey)
    return dx * dx + dy * dy, t


@njit(inline="always")
@no_type_check
def _pixel_range(low, high, reach, size):  # pragma: no cover - compiled
    """First and one past the last pixel whose centre may lie within reach of [low, high]."""
    first = int(max(np.ceil(low - reach - 0.5), 0.0))
    last = int(min(np.floor(high + reach - 0.5), size - 1.0)) + 1
    return first, last


@njit(parallel=True, cache=True, nogil=True)
@no_type_check
def _forward(pixels, depths, faces, drawn, sigma, blur, near, missed, depth):  # pragma: no cover
    meshes, height, width = missed.shape
    reach = np.sqrt(blur)
    inverse_sigma = 1.0 / sigma
    for mesh in prange(meshes):
        if not drawn[mesh]:
            continue
        for f in range(faces.shape[0]):
            ia, ib, ic = faces[f, 0], faces[f, 1], faces[f, 2]
            za, zb, zc = depths[mesh, ia], depths[mesh, ib], depths[mesh, ic]
            if za <= near or zb <= near or zc <= near:
                continue
            ax, ay = pixels[mesh, ia, 0], pixels[mesh, ia, 1]
            bx, by = pixels[mesh, ib, 0], pixels[mesh, ib, 1]
            cx, cy = pixels[mesh, ic, 0], pixels[mesh, ic, 1]
            area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            if abs(area) <= 1e-12:
                continue
            inverse_area = 1.0 / area
            left, right = _pixel_range(min(ax, bx, cx), max(ax, bx, cx), reach, width)
            top, bottom = _pixel_range(min(ay, by, cy), max(ay, by, cy), reach, height)
            for row in range(top, bottom):
                py = row + 0.5
                for column in range(left, right):
                    px = column + 0.5
                    wa = ((cx - bx) * (py - by) - (cy - by) * (px - bx)) * inverse_area
                    wb = ((ax - cx) * (py - cy) - (ay - cy) * (px - cx)) * inverse_area
                    wc = 1.0 - wa - wb
                    inside = wa > 0.0 and wb > 0.0 and wc > 0.0
                    if not inside or missed[mesh, row, column] < CERTAIN:
                        d1, _ = _nearest_on_edge(px, py, ax, ay, bx, by)
                        d2, _ = _nearest_on_edge(px, py, bx, by, cx, cy)
                        d3, _ = _nearest_on_edge(px, py, cx, cy, ax, ay)
                        d = min(d1, d2, d3)
                        if not inside and d >= blur:
                            continue
                        x = d * inverse_sigma if inside else -d * inverse_sigma
                        # softplus(x) = -log(1 - sigmoid(x))
                        missed[mesh, row, column] += max(x, 0.0) + np.log1p(np.exp(-abs(x)))
                    wa, wb, wc = max(wa, 0.0), max(wb, 0.0), max(wc, 0.0)
                    z = (wa + wb + wc) / (wa / za + wb / zb + wc / zc)
                    if z < depth[mesh, row, column]:
                        depth[mesh, row, column] = z


@njit(parallel=True, cache=True, nogil=True)
@no_type_check
def _backward(pixels, depths, faces, drawn, sigma, blur, near, pull, gradient):  # pragma: no cover
    """`pull` is dL/dcoverage times the chance to miss; it is zero where nothing can change."""
    meshes, height, width = pull.shape
    reach = np.sqrt(blur)
    inverse_sigma = 1.0 / sigma
    for mesh in prange(meshes):
        if not drawn[mesh]:
            continue
        for f in range(faces.shape[0]):
            ia, ib, ic = faces[f, 0], faces[f, 1], faces[f, 2]
            if depths[mesh, ia] <= near or depths[mesh, ib] <= near or depths[mesh, ic] <= near:
                continue
            ax, ay = pixels[mesh, ia, 0], pixels[mesh, ia, 1]
            bx, by = pixels[mesh, ib, 0], pixels[mesh, ib, 1]
            cx, cy = pixels[mesh, ic, 0], pixels[mesh, ic, 1]
            area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            if abs(area) <= 1e-12:
                continue
            inverse_area = 1.0 / area
            left, right = _pixel_range(min(ax, bx, cx), max(ax, bx, cx), reach, width)
            top, bottom = _pixel_range(min(ay, by, cy), max(ay, by, cy), reach, height)
            for row in range(top, bottom):
                py = row + 0.5
                for column in range(left, right):
                    force = pull[mesh, row, column]
                    if force == 0.0:
                        continue
                    px = column + 0.5
                    wa = ((cx - bx) * (py - by) - (cy - by) * (px - bx)) * inverse_area
                    wb = ((ax - cx) * (py - cy) - (ay - cy) * (px - cx)) * inverse_area
                    wc = 1.0 - wa - wb
                    inside = wa > 0.0 and wb > 0.0 and wc > 0.0
                    d1, t1 = _nearest_on_edge(px, py, ax, ay, bx, by)
                    d2, t2 = _nearest_on_edge(px, py, bx, by, cx, cy)
                    d3, t3 = _nearest_on_edge(px, py, cx, cy, ax, ay)
                    if d1 <= d2 and d1 <= d3:
                        d, t, i, j = d1, t1, ia, ib
                        sx, sy, ex, ey = ax, ay, bx, by
                    elif d2 <= d3:
                        d, t, i, j = d2, t2, ib, ic
                        sx, sy, ex, ey = bx, by, cx, cy
                    else:
                        d, t, i, j = d3, t3, ic, ia
                        sx, sy, ex, ey = cx, cy, ax, ay
                    if not inside and d >= blur:
                        continue
                    sign = 1.0 if inside else -1.0
                    missing = 1.0 / (1.0 + np.exp(-sign * d * inverse_sigma))
                    weight = force * sign * inverse_sigma * missing
                    # Moving the nearest point of the edge by its ends' shares changes d.
                    gx = -2.0 * weight * (px - (sx + t * (ex - sx)))
                    gy = -2.0 * weight * (py - (sy + t * (ey - sy)))
                    gradient[mesh, i, 0] += (1.0 - t) * gx
                    gradient[mesh, i, 1] += (1.0 - t) * gy
                    gradient[mesh, j, 0] += t * gx
                    gradient[mesh, j, 1] += t * gy


class _SoftCoverage(torch.autograd.Function):
    @staticmethod
    def forward(ctx, pixels, depths, faces, drawn, image_size, sigma_px2, blur_px2, near_m):
        arrays = (
            pixels.detach().contiguous().numpy(),
            depths.detach().contiguous().numpy(),
            faces.contiguous().numpy(),
            drawn.contiguous().numpy(),
        )
        dtype = arrays[0].dtype
        settings = (float(sigma_px2), float(blur_px2), float(near_m))
        shape = (len(pixels), *image_size)
        missed = np.zeros(shape, dtype=dtype)
        depth = np.full(shape, np.inf, dtype=dtype)
        _forward(*arrays, *settings, missed, depth)
        left = torch.from_numpy(np.exp(-missed))
        ctx.arrays, ctx.settings = arrays, settings
        ctx.save_for_backward(left)
        nearest = torch.from_numpy(depth)
        ctx.mark_non_differentiable(nearest)
        return torch.from_numpy(-np.expm1(-missed)), nearest

    @staticmethod
    def backward(ctx, grad_coverage, _grad_depth):
        (left,) = ctx.saved_tensors
        pull = (grad_coverage * left).contiguous().numpy()
        # Below float32's grasp of 1 the pixel is covered whatever the outline does.
        pull[left.numpy() < np.exp(-CERTAIN)] = 0.0
        gradient = np.zeros_like(ctx.arrays[0])
        _backward(*ctx.arrays, *ctx.settings, pull, gradient)
        return torch.from_numpy(gradient), *([None] * 7)


def soft_coverage(
    pixels: Float[Tensor, "meshes vertices 2"],
    depths: Float[Tensor, "meshes vertices"],
    faces: Int[Tensor, "faces 3"],
    drawn: Bool[Tensor, " meshes"],
    image_size: tuple[int, int],
    sigma_px2: float,
    blur_px2: float,
    near_m: float,
) -> tuple[Float[Tensor, "meshes height width"], Float[Tensor, "meshes height width"]]:
    """Coverage and depth of each mesh, alone: see `sceneprior.silhouettes.render`."""
    return _SoftCoverage.apply(
        pixels, depths, faces, drawn, image_size, sigma_px2, blur_px2, near_m
    )

"""Coverages and depths of single objects in, visible soft masks out.

`paper`: the coverage of the whole scene, given to the front-most object of each pixel. Two
objects that touch in the image do not push each other.

`layered`: object k is seen where it covers and nothing nearer does,

    visible_k = coverage_k * prod_{j nearer than k} (1 - coverage_j),

so a boundary between two objects moves the one in front, and reveals or hides the one behind.
The order is by depth at the pixel and carries no gradient.
"""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit, prange
from torch import Tensor

MODES = ("layered", "paper")


# no_type_check: the tests' type hook wraps every function, and Numba cannot compile a wrapper.
@njit(inline="always")
@no_type_check
def _order(depth, image, row, column, order):  # pragma: no cover - compiled
    """Objects that touch a pixel, nearest first (insertion sort: they are few)."""
    count = 0
    for k in range(depth.shape[1]):
        z = depth[image, k, row, column]
        if z == np.inf:
            continue
        place = count
        while place > 0 and depth[image, order[place - 1], row, column] > z:
            order[place] = order[place - 1]
            place -= 1
        order[place] = k
        count += 1
    return count


@njit(parallel=True, cache=True, nogil=True)
@no_type_check
def _forward(coverage, depth, layered, visible):  # pragma: no cover - compiled
    images, objects, height, width = coverage.shape
    for image in prange(images):
        order = np.empty(objects, dtype=np.int64)
        for row in range(height):
            for column in range(width):
                count = _order(depth, image, row, column, order)
                left = 1.0
                for place in range(count):
                    k = order[place]
                    if layered:
                        visible[image, k, row, column] = left * coverage[image, k, row, column]
                    left *= 1.0 - coverage[image, k, row, column]
                if count > 0 and not layered:
                    visible[image, order[0], row, column] = 1.0 - left


@njit(parallel=True, cache=True, nogil=True)
@no_type_check
def _backward(coverage, depth, layered, upstream, gradient):  # pragma: no cover - compiled
    images, objects, height, width = coverage.shape
    for image in prange(images):
        order = np.empty(objects, dtype=np.int64)
        before = np.empty(objects + 1, dtype=coverage.dtype)
        for row in range(height):
            for column in range(width):
                count = _order(depth, image, row, column, order)
                before[0] = 1.0
                for place in range(count):
                    alpha = coverage[image, order[place], row, column]
                    before[place + 1] = before[place] * (1.0 - alpha)
                behind = 0.0 if layered else 1.0
                for place in range(count - 1, -1, -1):
                    k = order[place]
                    alpha = coverage[image, k, row, column]
                    if layered:
                        pull = upstream[image, k, row, column]
                        gradient[image, k, row, column] = before[place] * (pull - behind)
                        behind = pull * alpha + (1.0 - alpha) * behind
                    else:
                        pull = upstream[image, order[0], row, column]
                        gradient[image, k, row, column] = pull * before[place] * behind
                        behind *= 1.0 - alpha


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, coverage, depth, layered):
        ctx.arrays = (coverage.detach().contiguous().numpy(), depth.contiguous().numpy())
        ctx.layered = layered
        visible = np.zeros_like(ctx.arrays[0])
        _forward(*ctx.arrays, layered, visible)
        return torch.from_numpy(visible)

    @staticmethod
    def backward(ctx, grad_visible):
        gradient = np.zeros_like(ctx.arrays[0])
        _backward(*ctx.arrays, ctx.layered, grad_visible.contiguous().numpy(), gradient)
        return torch.from_numpy(gradient), None, None


def composite(
    coverage: Float[Tensor, "images objects height width"],
    depth: Float[Tensor, "images objects height width"],
    compositing: str,
) -> Float[Tensor, "images objects height width"]:
    """Visible soft masks; `depth` is infinite where an object does not touch a pixel."""
    return _Composite.apply(coverage, depth, compositing == "layered")

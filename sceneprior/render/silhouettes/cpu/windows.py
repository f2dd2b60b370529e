"""Windows: the pixels that each projected mesh may touch, packed in one array.

A window is the bounding box of a projected mesh, grown by the blur radius and clipped to the image.
Memory grows with these pixels, not with objects x views x image. A window is stored in strips eight
pixels wide, from top to bottom, so that the loop over the pixels around a small face runs through
contiguous memory and the compiler vectorises it:

    pixel (row, column) of mesh m  ->  start[m] + ((column // 8 - strip0) * rows + row - row0) * 8
                                       + column % 8
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from sceneprior.render.silhouettes.cpu.threads import in_threads
from sceneprior.render.silhouettes.reference import Settings

LANES = 8
"""Width of a strip in pixels."""


class Windows(NamedTuple):
    """`bounds`: (meshes, 4) int32 of row0, row1, strip0, strip1; `start`: (meshes + 1,) int64."""

    bounds: np.ndarray
    start: np.ndarray


def windows_of(
    pixels: np.ndarray, depths: np.ndarray, drawn: np.ndarray, settings: Settings
) -> Windows:
    """Windows from (meshes, vertices, 2) pixels and (meshes, vertices) depths; empty for a mesh
    that is not drawn or outside the image."""
    bounds = np.zeros((len(pixels), 4), dtype=np.int32)
    reach_px = float(np.sqrt(settings.blur_px2))
    rest = (reach_px, float(settings.near_m), *settings.image_size, bounds)
    in_threads(_bounds, len(pixels), pixels, depths, drawn, *rest)
    area = (bounds[:, 1] - bounds[:, 0]).astype(np.int64) * (bounds[:, 3] - bounds[:, 2]) * LANES
    return Windows(bounds, np.concatenate([[0], np.cumsum(area)]))


@njit(inline="always")
def pixel_range(low, high, size):
    """First and one past the last pixel whose centre lies in [low, high], within the image."""
    first = int(min(max(np.ceil(low - 0.5), 0.0), float(size)))
    last = int(max(min(np.floor(high - 0.5), size - 1.0), -1.0)) + 1
    return first, last


@njit(cache=True, nogil=True)
def _bounds(first, last, pixels, depths, drawn, reach, near, height, width, bounds):
    for mesh in range(first, last):
        if not drawn[mesh]:
            continue
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        for v in range(pixels.shape[1]):
            if depths[mesh, v] > near:
                x, y = pixels[mesh, v, 0], pixels[mesh, v, 1]
                left, right = min(left, x), max(right, x)
                top, bottom = min(top, y), max(bottom, y)
        if left > right:
            continue
        column0, column1 = pixel_range(left - reach, right + reach, width)
        row0, row1 = pixel_range(top - reach, bottom + reach, height)
        if column0 < column1 and row0 < row1:
            bounds[mesh, 0], bounds[mesh, 1] = row0, row1
            bounds[mesh, 2], bounds[mesh, 3] = column0 // 8, (column1 - 1) // 8 + 1

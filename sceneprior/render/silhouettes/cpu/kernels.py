"""Helpers of the Numba kernels: windows, work in threads, and a vectorised exponential.

Work in threads: a loop takes the index of its first item and one past the last, releases the GIL,
and writes only to these items, so the result does not depend on the number of threads. Numba's own
parallel loops would take several times as long to compile.

Windows: a window is the bounding box of a projected mesh, grown by the blur radius and clipped to
the image. Memory grows with these pixels, not with objects x views x image. A window is stored in
strips eight pixels wide, from top to bottom, so that the loop over the pixels around a small face
runs through contiguous memory and the compiler vectorises it:

    pixel (row, column) of mesh m  ->  start[m] + ((column // 8 - strip0) * rows + row - row0) * 8
                                       + column % 8
"""

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, NamedTuple, no_type_check

import numba
import numpy as np
from numba import njit, types
from numba.extending import intrinsic, overload

from sceneprior.render.silhouettes.reference import Settings

CHUNKS = 3
"""Parts per thread; more parts balance uneven work better."""


def in_threads(function: Callable[..., None], items: int, *arguments: Any) -> None:
    """Call function(first, last, *arguments) for parts that cover range(items).

    It uses `thread_count()` threads.
    """
    threads = thread_count()
    parts = min(items, threads * CHUNKS if threads > 1 else 1)
    if parts < 2:
        function(0, items, *arguments)
        return
    ends = [items * part // parts for part in range(parts + 1)]
    pool = _pool(os.getpid(), threads)
    jobs = [pool.submit(function, *part, *arguments) for part in itertools.pairwise(ends)]
    for job in jobs:
        job.result()


def thread_count() -> int:
    """Number of threads that Numba may use: NUMBA_NUM_THREADS, or all cores."""
    # numba.get_num_threads() would start Numba's own pool, which with OpenMP overrides torch's
    # number of threads.
    count: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    return count


@lru_cache(maxsize=4)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    # One pool per process id, since threads do not survive a fork.
    return ThreadPoolExecutor(threads, thread_name_prefix="silhouettes")


@intrinsic
def _float_of_bits(_context, _bits):
    def build(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.float32))

    return types.float32(types.int32), build


@no_type_check
def vector_exp(x):
    """e**x for -80 <= x <= 80, in the precision of x; `_compiled` replaces it in Numba code."""
    return np.exp(x)


@overload(vector_exp, inline="always")
@no_type_check
def _compiled(x):
    if x != types.float32:
        return lambda x: np.exp(x)

    def exp32(x):
        # A library call would prevent vectorisation, so e**x = 2**n * e**f with |f| <= ln(2) / 2;
        # the series to f**6 is within 2 units in the last place.
        n = np.int32(np.floor(x * np.float32(1.4426950408889634) + np.float32(0.5)))
        f = x - np.float32(n) * np.float32(0.6931471805599453)
        series = np.float32(1 / 720)
        series = series * f + np.float32(1 / 120)
        series = series * f + np.float32(1 / 24)
        series = series * f + np.float32(1 / 6)
        series = series * f + np.float32(1 / 2)
        series = series * f + np.float32(1)
        series = series * f + np.float32(1)
        return series * _float_of_bits(np.int32((n + np.int32(127)) << np.int32(23)))

    return exp32


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

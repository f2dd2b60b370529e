"""Runs a compiled loop over meshes or images on several threads.

Each function takes the first and one past the last of its items, lets go of the interpreter's
lock, and writes only what belongs to them, so the result does not depend on how many threads
there are. Numba's own parallel loops would take several times as long to compile.
"""

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import numba

CHUNKS = 3
"""Parts a thread: the more, the better shared is uneven work."""


def in_threads(function: Callable[..., None], items: int, *arguments: Any) -> None:
    """Call function(first, last, *arguments) for all of range(items).

    As many threads as Numba may use (NUMBA_NUM_THREADS, or all cores).
    """
    # numba.get_num_threads() would start Numba's own pool, and where that is OpenMP's, as many of
    # torch's threads, whatever torch was told.
    threads: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    parts = min(items, threads * CHUNKS if threads > 1 else 1)
    if parts < 2:
        function(0, items, *arguments)
        return
    ends = [items * part // parts for part in range(parts + 1)]
    pool = _pool(os.getpid(), threads)
    jobs = [pool.submit(function, *part, *arguments) for part in itertools.pairwise(ends)]
    for job in jobs:
        job.result()


@lru_cache(maxsize=4)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    # By process: threads do not survive a fork.
    return ThreadPoolExecutor(threads, thread_name_prefix="silhouettes")

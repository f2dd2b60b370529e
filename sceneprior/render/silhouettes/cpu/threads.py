"""Runs a compiled loop over meshes or images on several threads.

The loop is a function that takes the index of its first item and one past the last, releases the
GIL, and writes only to these items, so the result does not depend on the number of threads. Numba's
own parallel loops would take several times as long to compile.
"""

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import numba

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

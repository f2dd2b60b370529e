"""Runs functions in worker processes, with a progress bar."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from typing import Any

from sceneprior.core.errors import InputError

Run = Callable[..., Iterator[Any]]


@contextlib.contextmanager
def pool(workers: int) -> Iterator[Run]:
    """Open a process pool as `run(function, argument_lists, title)`, which yields results in order.

    A single worker is this process itself. A progress bar goes to stderr if there is a title.
    """
    if workers <= 1:
        yield _in_process
        return
    # Processes are spawned, never forked, because a GL context does not survive a fork.
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(workers, context, initializer=_start_worker)

    def submit(function: Callable[..., Any], *item: Any) -> Any:
        # Only this process handles Ctrl-C; workers inherit the blocked signal.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return executor.submit(function, *item)
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})

    def in_order(
        function: Callable[..., Any], arguments: list[Any], title: str | None
    ) -> Iterator[Any]:
        for future in _tracked([submit(function, *item) for item in arguments], title):
            yield future.result()

    try:
        yield in_order
    except BrokenProcessPool:
        raise InputError(
            "A worker process died (was it killed for lack of memory?). Finished shards are kept: "
            "run the same command again, perhaps with fewer --workers."
        ) from None
    except BaseException:
        # Killing them leaves no partial files: files are written whole or not at all.
        for worker in multiprocessing.active_children():
            worker.kill()
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _in_process(
    function: Callable[..., Any], arguments: list[Any], title: str | None
) -> Iterator[Any]:
    for item in _tracked(arguments, title):
        yield function(*item)


def _tracked(items: list[Any], title: str | None) -> Iterable[Any]:
    """The items, with a progress bar on stderr if there is a title."""
    if title is None or not items:
        return items
    from rich.console import Console
    from rich.progress import track

    return track(items, title, console=Console(stderr=True))


def _start_worker() -> None:
    # llvmpipe's own threads would compete with the other workers for the same cores.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        wait([parent.sentinel])  # type: ignore[union-attr]
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()

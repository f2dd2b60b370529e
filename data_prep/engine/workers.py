"""Runs functions in worker processes, with a progress bar."""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from multiprocessing.synchronize import Event
from typing import Any

from sceneprior.core.errors import InputError

Run = Callable[..., Iterator[Any]]

# Spawned, never forked: a GL context does not survive a fork.
_START_METHOD = "spawn"


@contextlib.contextmanager
def pool(workers: int) -> Iterator[Run]:
    """Open a process pool as `run(function, argument_lists, title)`, which yields results in order.

    A single worker is this process itself. A progress bar goes to stderr if there is a title.
    """
    if workers <= 1:

        def in_process(
            function: Callable[..., Any], arguments: list[Any], title: str | None
        ) -> Iterator[Any]:
            with progress(title, len(arguments)) as advance:
                for item in arguments:
                    result = function(*item)
                    advance()
                    yield result

        yield in_process
        return
    context = multiprocessing.get_context(_START_METHOD)
    stop = context.Event()
    executor = ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(stop,))

    def in_pool(
        function: Callable[..., Any], arguments: list[Any], title: str | None
    ) -> Iterator[Any]:
        with progress(title, len(arguments)) as advance:
            # Only this process handles Ctrl-C; workers inherit the blocked signal.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                futures: list[Future[Any]] = [
                    executor.submit(_unless_stopped, function, *item) for item in arguments
                ]
            finally:
                signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            for future in futures:
                future.add_done_callback(lambda _: advance())
            for future in futures:
                yield future.result()

    try:
        yield in_pool
    except BrokenProcessPool:
        raise InputError(
            "A worker process died (was it killed for lack of memory?). Finished shards are kept: "
            "run the same command again, perhaps with fewer --workers."
        ) from None
    except BaseException:
        stop.set()  # lets workers skip the queued tasks that can no longer be cancelled
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


_stop: Event | None = None  # in a worker: set when the job is abandoned


def _unless_stopped(function: Callable[..., Any], *arguments: Any) -> Any:
    return None if _stop is not None and _stop.is_set() else function(*arguments)


def _start_worker(stop: Event) -> None:
    global _stop
    _stop = stop
    # llvmpipe's own threads would compete with the other workers for the same cores.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        wait([parent.sentinel])  # type: ignore[union-attr]
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextlib.contextmanager
def progress(title: str | None, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar on stderr if there is a title; yields the function that advances it."""
    if title is None or not total:
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    with Progress(
        "{task.description}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        console=Console(file=sys.stderr),
    ) as progress:  # fmt: skip
        task = progress.add_task(title, total=total)
        yield lambda: progress.advance(task)

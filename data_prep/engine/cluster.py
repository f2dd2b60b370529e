"""Runs functions on the workers of a Dask cluster; the interface is that of workers.py."""

import contextlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from data_prep.engine.workers import Run, in_order
from sceneprior import __version__
from sceneprior.core.errors import InputError

_CONNECT_S = 20
_WORKERS_S = 60
_KEPT = "Finished shards are kept: run the same command again to continue."


@contextlib.contextmanager
def cluster(address: str) -> Iterator[Run]:
    """Open a cluster as `run(function, argument_lists, title)`, which yields results in order.

    Start the cluster with `dask scheduler` and, on each machine, `dask worker tcp://... --nworkers
    auto --nthreads 1`. Every machine needs this package, and the folders of data and shards under
    the same paths. If a worker dies, another takes over its task.
    """
    with _connect(address) as client:
        from distributed import CancelledError, KilledWorker
        from distributed.comm import CommClosedError

        def submit(function: Callable[..., Any], *item: Any) -> Any:
            # pure=False: the scheduler must not return cached results of an earlier job.
            return client.submit(_in_one_thread, function, *item, pure=False)

        try:
            yield lambda *work: in_order(submit, *work)
        except KilledWorker:
            raise InputError(
                f"A task of the cluster at {address} killed every worker that ran it (for lack of "
                f"memory?). {_KEPT}"
            ) from None
        except (CancelledError, CommClosedError, TimeoutError) as error:
            raise InputError(
                f"The cluster at {address} was lost ({type(error).__name__}). {_KEPT}"
            ) from None


@contextlib.contextmanager
def _connect(address: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            "--scheduler needs dask.distributed; install it with `pip install "
            "'sceneprior[cluster]'`."
        ) from None
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise InputError(f"No Dask scheduler answers at {address} ({reason}).") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError:
            raise InputError(
                f"The Dask scheduler at {address} has no workers; start some with "
                f"`dask worker {address} --nworkers auto --nthreads 1`."
            ) from None
        try:
            versions = client.run(_version)
        except Exception as error:
            raise InputError(
                f"The workers of {address} cannot run this package ({type(error).__name__}: "
                f"{error}); install sceneprior {__version__} where they run."
            ) from None
        others = {worker: found for worker, found in versions.items() if found != __version__}
        if others:
            worker, found = next(iter(others.items()))
            raise InputError(
                f"Worker {worker} has sceneprior {found}, and this is {__version__}: shards of two "
                "releases would differ. Install the same on every machine."
            )
        yield client


def _version() -> str:
    return __version__


_thread = ThreadPoolExecutor(max_workers=1)


def _in_one_thread(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call the function in the worker's single task thread.

    A worker may have several threads, but a GL context and our caches belong to one thread.
    """
    # llvmpipe's own threads would compete with the other workers for the same cores.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    return _thread.submit(function, *arguments).result()

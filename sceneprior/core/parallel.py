"""Work on many rooms: a map over tasks in this process, in local processes, or on a Dask cluster.

Functions call `run_tasks`; where the tasks run is chosen around them:

    with on_workers(2):  # or on_workers(scheduler="tcp://head:8786")
        build_shards(job)

A task depends on its arguments and on files alone, so the results are the same bytes everywhere.
"""

import contextlib
import multiprocessing
import os
import pickle
import signal
import socket
import threading
import traceback
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextvars import ContextVar
from functools import cache
from multiprocessing import connection
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from sceneprior import __version__
from sceneprior.core.errors import InputError, InputWarning, cause_of, sentence_of

MOST_FAILED = 10
"""Number of failed tasks after which no others are begun: the disk may be full."""
_DEATHS = 2
"""Deaths of workers after which the tasks under way are run one by one, which finds the task that
kills its worker."""
_CONNECT_S, _WORKERS_S, _NAMED = 20, 60, 3
_KILLED = "The task killed every process that it was given to (for lack of memory?)."
_Result = TypeVar("_Result")


class _Answer(NamedTuple):
    result: Any
    warnings: tuple[str, ...] = ()


class _Here:
    """Runs each task in this process when it is submitted."""

    def most(self) -> int:
        """Number of tasks to submit before the first has to be completed."""
        return 1

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        future = Future[Any]()
        try:
            future.set_result(_Answer(function(*arguments)))
        except Exception as error:
            future.set_exception(error)
        return future

    def stop(self) -> None:
        """End submitted tasks at once."""


class _Processes:
    """Processes on this machine; `restart` replaces them after one has died."""

    def __init__(self, count: int):
        self.count = count
        self.restart()

    def most(self) -> int:
        return 2 * self.count

    def restart(self) -> None:
        # Processes are spawned, never forked, because a GL context does not survive a fork.
        context = multiprocessing.get_context("spawn")
        self.pool = ProcessPoolExecutor(self.count, context, initializer=_start_worker)

    def submit(self, *call: Any) -> Future[Any]:
        # Only this process handles Ctrl-C; workers inherit the blocked signal.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return self.pool.submit(_run_pickled, pickle.dumps(call))
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})

    def stop(self) -> None:
        # Killing them leaves no partial files: files are written whole or not at all.
        for worker in multiprocessing.active_children():
            worker.kill()
        self.pool.shutdown(cancel_futures=True)
        self.restart()  # starts no process before a task is submitted


class _Cluster:
    """Workers of a Dask scheduler, which itself retries the tasks of workers that die or leave."""

    def __init__(self, client: Any):
        # pure=False: the scheduler must not return what an earlier command left there.
        self.client, self.executor = client, client.get_executor(pure=False)

    def most(self) -> int:
        return 2 * max(1, len(self.client.nthreads()))  # workers may join at any time

    def submit(self, *call: Any) -> Future[Any]:
        # Pickled here, so that it is unpickled by the thread and in the folder of the task.
        here = self.client.id, Path.cwd()
        return self.executor.submit(_run_there, *here, pickle.dumps(call))  # type: ignore

    def stop(self) -> None:
        self.executor.shutdown(wait=False)  # cancels what is submitted
        self.executor = self.client.get_executor(pure=False)


_where: ContextVar[Any] = ContextVar("_where")


@contextlib.contextmanager
def on_workers(count: int | None = 1, scheduler: str | None = None) -> Iterator[None]:
    """Choose where `run_tasks` works within a `with` block.

    Args:
        count: Number of processes on this machine; 1 is this process itself, None one per core.
        scheduler: Address of a Dask scheduler whose workers are used instead (docs/cluster.md).

    Raises:
        InputError: the scheduler cannot be used; the message says why.
    """
    count = count or len(os.sched_getaffinity(0))
    with contextlib.ExitStack() as until_done:
        where: Any = _Here()
        if scheduler is not None:
            where = _Cluster(until_done.enter_context(_connected(scheduler)))
        elif count > 1:
            where = _Processes(count)
            until_done.callback(lambda: where.pool.shutdown())
        token = _where.set(where)
        until_done.callback(_where.reset, token)
        yield


def run_tasks(
    function: Callable[..., _Result], tasks: Mapping[str, tuple[Any, ...]], title: str | None = None
) -> list[_Result]:
    """Call `function(*arguments)` for each task, and return the results in the order of the tasks.

    If a task fails, the others are done nevertheless; then its error is raised. Only a few tasks
    are submitted at a time, so that their arguments do not fill the memory of a scheduler.

    Args:
        function: A function of a module that workers import. In a task, `run_tasks` works in the
            task's own process.
        tasks: Arguments by name of the task, for errors.
        title: Title of a progress bar on stderr, for several tasks; None for no bar.

    Raises:
        InputError: tasks failed, or killed every worker that they were given to.
    """
    where = _where.get(_Here())
    found: dict[str, _Result] = {}
    failed: dict[str, Exception] = {}
    completed: Iterable[tuple[str, _Answer | Exception]] = _completed(where, function, tasks)
    if title is not None and len(tasks) > 1:
        from rich.console import Console
        from rich.progress import track

        completed = track(completed, title, len(tasks), console=Console(stderr=True))
    try:
        for name, outcome in completed:
            if isinstance(outcome, _Answer):
                found[name] = outcome.result
                for sentence in outcome.warnings:
                    warnings.warn(sentence, InputWarning, stacklevel=2)
                continue
            failed[name] = outcome
            if len(failed) >= MOST_FAILED:
                break
    except BaseException:
        where.stop()
        raise
    if failed:
        where.stop()
        failed = {name: failed[name] for name in tasks if name in failed}
        alike = not found and len({str(error) for error in failed.values()}) == 1
        raise failed.popitem()[1] if alike else _error_of(failed, len(tasks))
    return [found[name] for name in tasks]


def map_blocks(
    function: Callable[..., list[_Result]], items: Sequence[Any], size: int, title: str = ""
) -> list[_Result]:
    """Call `function(some, first)` in a task for every `size` items; `first` is the index of their
    first. Returns all results in one list."""
    tasks = {
        f"items from {k + 1}, {getattr(items[k], 'name', 'unnamed')}, on": (items[k:][:size], k)
        for k in range(0, len(items), size)
    }
    return [each for part in run_tasks(function, tasks, title or None) for each in part]


@cache
def once(function: Callable[..., _Result], *arguments: Any) -> _Result:
    """Call a function that opens files: in a worker, once a command; for `__reduce__`."""
    with warnings.catch_warnings(action="ignore"):  # the command has shown them
        return function(*arguments)


def check_shared(path: Path) -> None:
    """Check in a task that its worker sees what the command has made."""
    if not path.exists():
        raise InputError(
            f"A worker finds no {path}: workers must reach the same folders, under the same paths, "
            "as the machine on which the command runs."
        )


def _completed(
    where: Any, function: Callable[..., Any], tasks: Mapping[str, tuple[Any, ...]]
) -> Iterator[tuple[str, _Answer | Exception]]:
    """Answers of tasks as they are completed, or their errors. Tasks that a dying process took
    along are submitted again."""
    todo, pending, deaths = deque(tasks), dict[Future[Any], str](), Counter[str]()
    while todo or pending:
        most, lost, broken = where.most(), list[str](), False
        suspects = {name for name, count in deaths.items() if count >= _DEATHS}
        try:
            while todo and len(pending) < most:
                if pending and suspects & {todo[0], *pending.values()}:
                    break
                pending[where.submit(function, *tasks[todo[0]])] = todo[0]
                todo.popleft()
        except BrokenExecutor:  # since the last task was completed
            broken = True
        for future in wait(pending, return_when=FIRST_COMPLETED).done:
            name, error = pending.pop(future), future.exception()
            if isinstance(error, BrokenExecutor):
                lost.append(name)
            elif type(error).__name__ == "KilledWorker" and name not in suspects:
                deaths[name] = _DEATHS  # Dask blames all tasks that a dead worker held
                todo.appendleft(name)
            else:
                outcome: Any = error or future.result()
                yield name, outcome
        if broken or lost:
            lost += pending.values()
            pending.clear()
            where.restart()
            deaths.update(lost)
            if len(lost) == 1 and deaths[lost[0]] > _DEATHS:
                yield lost.pop(), InputError(_KILLED)
            todo.extendleft(reversed(lost))


def _error_of(failed: dict[str, Exception], total: int) -> Exception:
    """One error for all failed tasks: that of the first, with the names of the others."""
    (name, error), *others = failed.items()
    killed = type(error).__name__ == "KilledWorker"  # Dask's
    sentence = _KILLED if killed else sentence_of(error)
    if sentence is None:
        return error
    if name not in sentence:
        sentence = f"{name}: {sentence}"
    if others:
        named = ", ".join(name for name, _ in others[:_NAMED])
        more = f" and {len(others) - _NAMED} more" * (len(others) > _NAMED)
        sentence += f" {len(failed)} of {total} tasks failed, also {named}{more}."
    return InputError(sentence) if sentence != str(error) else error


# -- In a worker -----------------------------------------------------------------------------------


def _run_pickled(call: bytes) -> "_Answer":
    """Run a task; errors are raised as types that any process can unpickle."""
    # Threads of llvmpipe and Numba would compete with the other workers for the same cores.
    for library in ("LP", "NUMBA", "OMP"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", InputWarning)
            function, *arguments = pickle.loads(call)
            result = function(*arguments)
        return _Answer(result, tuple(str(warning.message) for warning in said))
    except Exception as error:
        sentence = sentence_of(error)
        if sentence is not None:
            raise InputError(sentence) from None
        raise RuntimeError("".join(traceback.format_exception(error))) from None


def _start_worker() -> None:
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        connection.wait([parent.sentinel])  # type: ignore[union-attr]
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


_thread, _command = ThreadPoolExecutor(1), [""]


def _run_there(command: str, folder: Path, call: bytes) -> "_Answer":
    """Run a task in the folder of the command, and in the only thread for tasks: a worker may have
    several, but a GL context and our caches belong to one."""
    check_shared(folder)
    os.chdir(folder)
    if _command != [command]:  # files may have changed since the last one
        once.cache_clear()
        _command[:] = [command]
    return _thread.submit(_run_pickled, call).result()


# -- A cluster -------------------------------------------------------------------------------------


@contextlib.contextmanager
def _connected(address: str) -> Iterator[Any]:
    """A client of a Dask scheduler whose workers can run this package."""
    try:
        import distributed
        from distributed.comm import CommClosedError
    except ImportError:
        raise InputError("--scheduler needs Dask: `pip install 'sceneprior[cluster]'`.") from None
    try:
        # Tried first: a client that cannot connect keeps Python from exiting.
        host, _, port = address.rpartition("//")[2].rpartition(":")
        socket.create_connection((host, int(port)), _CONNECT_S).close()
        client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        reason = cause_of(error) if isinstance(error, OSError) else "it names no port"
        raise InputError(
            f"No Dask scheduler answers at {address} ({reason}); expected the address that `dask "
            "scheduler` prints, such as tcp://10.0.0.1:8786."
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError:
            advice = f"start some: `dask worker {address} --nthreads 1`"
            raise InputError(f"{address} has no workers; {advice}.") from None
        try:
            versions = client.run(_version)
        except Exception as error:
            versions = {"a worker": f"none ({cause_of(error)})"}
        for worker, found in versions.items():
            if found != __version__:
                raise InputError(
                    f"The release of sceneprior on {worker} is {found}, and here {__version__}; "
                    "install the same on every machine, since results of others may differ."
                )
        try:
            yield client
        except (CancelledError, distributed.CancelledError, CommClosedError) as error:
            raise InputError(
                f"The cluster at {address} was lost ({type(error).__name__}). What is finished is "
                "kept: run the same command again to continue."
            ) from None


def _version() -> str:
    return __version__

"""Runs commands of `sceneprior` as steps of an experiment, which can be stopped and goes on.

Each command is a process of its own, so that a reader who doubts a number can type it again. The
`steps.json` of a folder notes the command of each step, what it took and whether it finished.
"""

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import takewhile
from operator import add
from pathlib import Path
from typing import Any

import psutil

from sceneprior.errors import InputError
from sceneprior.files import only_writer, read_json, write_json

SAMPLE_EVERY_S = 0.5
_COSTS: dict[str, Callable] = {"cpu_s": add, "wall_s": add, "peak_memory_gib": max}
"""What is noted of a command, and how it combines where a stopped one goes on."""


@dataclass(frozen=True)
class Step:
    """A command of `sceneprior`, and what tells whether it has to run."""

    name: str
    arguments: list[str]
    result: Path
    """What the command leaves; a step whose result was deleted runs again."""
    depends_on: list[str]
    """What the result is made for: the step runs again once this differs."""
    continues: Path | None = None
    """What the command goes on from after a stop; while it is there, costs add up."""


@dataclass
class StepRunner:
    """Runs steps, several at a time on request, and stops them together; from `open_runner`."""

    pool: ThreadPoolExecutor
    threads: int | None = None
    """A command's share of the cores; None leaves it all of them."""
    stopped: bool = False
    _running: set[subprocess.Popen[bytes]] = field(default_factory=set)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def stop(self) -> None:
        """Begin no more steps, and let those that run save what they have, as Ctrl-C would."""
        with self._lock:
            self.stopped = True
            for process in self._running:
                # Not Popen's own way, which would take the exit status that wait4 waits for.
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGINT)

    def do(
        self, step: Step, folder: Path, log: Path | None = None, unshown: Sequence[str] = ()
    ) -> None:
        """Run a step, note it in `folder`, and forget the steps after it, whose results are old.

        What the command prints goes to `log`, or to the terminal; `unshown` are further arguments,
        neither printed nor noted.

        Raises:
            InputError: the command failed; its own sentence, where it left one in `log`.
        """
        if self.stopped:
            return
        print(f"$ sceneprior {shlex.join(step.arguments)}", file=sys.stderr, flush=True)
        noted = read_journal(folder)
        took: dict[str, Any] = dict.fromkeys(_COSTS, 0.0)
        if step.continues is not None and step.continues.exists():
            took = {cost: noted.get(step.name, {}).get(cost) for cost in _COSTS}
        earlier = dict(takewhile(lambda item: item[0] != step.name, noted.items()))
        entry: dict[str, Any] = {"arguments": step.arguments, "depends_on": step.depends_on}
        # Without costs, until it ends: those of a command that is killed are unknown.
        write_json(folder / "steps.json", {**earlier, step.name: entry})
        ended = self.call([*step.arguments, *unshown], log)
        status, costs = ended or (None, dict.fromkeys(_COSTS, 0.0))
        for cost, combine in _COSTS.items():
            entry[cost] = None if took[cost] is None else combine(took[cost], costs[cost])
        write_json(folder / "steps.json", {**earlier, step.name: entry | {"finished": status == 0}})
        if status and not self.stopped:
            raise InputError(failure_reason(log, status))

    def call(self, arguments: Sequence[str], log: Path | None) -> tuple[int, dict] | None:
        """Exit status and costs of a command; None where all were stopped before it began."""
        share = {}
        if self.threads is not None:
            share = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), str(self.threads))
        start, over = time.monotonic(), threading.Event()
        with contextlib.ExitStack() as until_ended:
            output = None if log is None else until_ended.enter_context(log.open("wb"))
            watcher = until_ended.enter_context(ThreadPoolExecutor(1))
            with self._lock:
                if self.stopped:
                    return None
                process = subprocess.Popen(
                    [sys.executable, "-m", "sceneprior", *arguments],
                    stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                    env={**os.environ, **share},
                    process_group=0,  # `stop` tells it of a Ctrl-C, and once
                )  # fmt: skip
                self._running.add(process)
            peak = watcher.submit(_peak_bytes, process.pid, over)
            # wait4 knows what this child alone has used, with all that it waited for itself.
            _, status, used = os.wait4(process.pid, 0)
            over.set()
            with self._lock:
                self._running.remove(process)
                process.returncode = os.waitstatus_to_exitcode(status)
        return process.returncode, {
            "cpu_s": used.ru_utime + used.ru_stime,
            "wall_s": time.monotonic() - start,
            "peak_memory_gib": peak.result() / 2**30,
        }


@contextlib.contextmanager
def open_runner(out: Path, jobs: int = 1) -> Iterator[StepRunner]:
    """A runner of steps that write below `out`, where no other may run meanwhile.

    While it is open, Ctrl-C, SIGTERM and SIGHUP let its commands save what they have, and raise
    KeyboardInterrupt.

    Raises:
        InputError: another runner is writing to `out`, or it cannot be written.
    """
    # Threads of several jobs on one core wait for each other, spinning: each job has its share.
    threads = max(1, (os.cpu_count() or 1) // jobs) if jobs > 1 else None
    with contextlib.ExitStack() as until_done:
        try:
            until_done.enter_context(only_writer(out))
        except OSError as error:
            raise InputError(f"{out} cannot be written ({error.strerror}).") from None
        until_done.enter_context(_ended_as_by_ctrl_c())
        runner = StepRunner(until_done.enter_context(ThreadPoolExecutor(jobs)), threads)
        until_done.callback(runner.stop)  # what still runs, after Ctrl-C or a fault of ours
        yield runner


def is_done(step: Step, folder: Path, as_asked: bool = True) -> bool:
    """Whether a step has finished and its result is there; if `as_asked`, for what it depends on.

    Raises:
        InputError: the journal is damaged.
    """
    noted = read_journal(folder).get(step.name, {})
    same = not as_asked or noted.get("depends_on") == step.depends_on
    return same and bool(noted.get("finished")) and step.result.exists()


def read_journal(folder: Path) -> dict[str, Any]:
    """What `steps.json` notes of each step; empty where nothing has run."""
    path = folder / "steps.json"
    return read_result(path) if path.is_file() else {}


def read_result(path: Path) -> dict[str, Any]:
    """A JSON file that a step left.

    Raises:
        InputError: it is damaged.
    """
    try:
        return dict(read_json(path))
    except (InputError, TypeError, ValueError):
        raise InputError(
            f"{path} is damaged; delete it and run the same command again: training is kept."
        ) from None


def failure_reason(log: Path | None, status: int) -> str:
    """The sentence a command failed with, or its last words."""
    if log is None:
        return f"exit status {status}"
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines()]
    errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")]
    told = errors or [line for line in lines if line]
    if status < 0 and not errors:
        return f"killed by {signal.Signals(-status).name}; the same command goes on"
    return told[-1] if told else f"it said nothing in {log}"


def _peak_bytes(pid: int, over: threading.Event) -> int:
    """Most memory that a process and its descendants held together, until `over`."""
    peak = 0
    while not over.wait(SAMPLE_EVERY_S):
        held = 0
        with contextlib.suppress(psutil.NoSuchProcess):
            parent = psutil.Process(pid)
            for process in [parent, *parent.children(recursive=True)]:
                with contextlib.suppress(psutil.NoSuchProcess):
                    held += process.memory_info().rss
        peak = max(peak, held)
    return peak


@contextlib.contextmanager
def _ended_as_by_ctrl_c() -> Iterator[None]:
    """Answer every signal that asks this process to end: its commands, which it does not reach,
    must save."""
    if threading.current_thread() is not threading.main_thread():
        yield  # where no signal can be answered
        return
    names = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {name: signal.getsignal(name) for name in names}
    for name, handler in before.items():
        if handler is not signal.SIG_IGN:  # as nohup asks for
            signal.signal(name, signal.default_int_handler)
        elif name == signal.SIGINT:
            # In the background. Commands inherit what is ignored, but not an answer, and have to
            # hear the SIGINT by which `StepRunner.stop` ends them.
            signal.signal(name, lambda number, frame: None)
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(name, handler)

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
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import takewhile
from operator import add
from pathlib import Path
from typing import Any

from sceneprior.core.errors import InputError
from sceneprior.core.files import only_writer, read_json, write_json

_COSTS: dict[str, Callable] = {"cpu_s": add, "wall_s": add, "peak_memory_gib": max}
"""Costs noted of a command, and how those of a stopped command and its continuation combine."""


@dataclass(frozen=True)
class Step:
    """A command of `sceneprior`, and what tells whether it has to run."""

    name: str
    arguments: list[str]
    result: Path
    """File that the command writes; a step whose result was deleted runs again."""
    depends_on: list[str]
    """Inputs of the result: the step runs again once they differ."""
    continues: Path | None = None
    """File from which the command continues after a stop; while it is there, costs add up."""


class StepRunner:
    """Runs steps one after the other, until it is stopped; from `open_runner`."""

    def __init__(self) -> None:
        self.stopped = self._calling = False
        self._process: subprocess.Popen[bytes] | None = None

    def stop(self, *signal_and_frame: Any) -> None:
        """Answer a signal that asks this process to end: the command that runs saves what it has,
        as it does after Ctrl-C, and no step follows."""
        self.stopped = True
        if not self._calling:
            raise KeyboardInterrupt
        if self._process is not None:
            # Not Popen's own way, which would take the exit status that wait4 waits for.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGINT)

    def do(
        self, step: Step, folder: Path, log: Path | None = None, unshown: Sequence[str] = ()
    ) -> None:
        """Run a step, note it in `folder`, and forget the steps after it, whose results are old.

        What the command prints goes to `log`, or to the terminal; `unshown` are further arguments,
        neither printed nor noted.

        Raises:
            InputError: the command failed; its own sentence, where it left one in `log`.
            KeyboardInterrupt: the runner was stopped; what the command took until then is noted.
        """
        if self.stopped:
            raise KeyboardInterrupt
        print(f"$ sceneprior {shlex.join(step.arguments)}", file=sys.stderr, flush=True)
        noted = read_journal(folder)
        took: dict[str, Any] = dict.fromkeys(_COSTS, 0.0)
        if step.continues is not None and step.continues.exists():
            took = {cost: noted.get(step.name, {}).get(cost) for cost in _COSTS}
        earlier = dict(takewhile(lambda item: item[0] != step.name, noted.items()))
        entry: dict[str, Any] = {"arguments": step.arguments, "depends_on": step.depends_on}
        # Without costs, until it ends: those of a command that is killed are unknown.
        write_json(folder / "steps.json", {**earlier, step.name: entry})
        status, costs = self.call([*step.arguments, *unshown], log)
        for cost, combine in _COSTS.items():
            entry[cost] = None if took[cost] is None else combine(took[cost], costs[cost])
        write_json(folder / "steps.json", {**earlier, step.name: entry | {"finished": status == 0}})
        if self.stopped:
            raise KeyboardInterrupt
        if status:
            raise InputError(failure_reason(log, status))

    def call(self, arguments: Sequence[str], log: Path | None) -> tuple[int, dict[str, float]]:
        """Run a command to its end: its exit status and costs."""
        start = time.monotonic()
        with contextlib.nullcontext() if log is None else log.open("wb") as output:
            self._calling = True
            try:
                self._process = process = subprocess.Popen(
                    [sys.executable, "-m", "sceneprior", *arguments],
                    stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                    process_group=0,  # `stop` tells it of a Ctrl-C, and once
                )  # fmt: skip
                if self.stopped:  # while it began
                    self.stop()
                # wait4 knows what this child alone has used, with all that it waited for itself.
                _, status, used = os.wait4(process.pid, 0)
                process.returncode = os.waitstatus_to_exitcode(status)
            finally:
                self._process, self._calling = None, False
        return process.returncode, {
            "cpu_s": used.ru_utime + used.ru_stime,
            "wall_s": time.monotonic() - start,
            "peak_memory_gib": used.ru_maxrss / 2**20,  # KiB; its largest process, or this one
        }


@contextlib.contextmanager
def open_runner(out: Path) -> Iterator[StepRunner]:
    """A runner of steps that write below `out`, where no other may run meanwhile.

    While it is open, Ctrl-C, SIGTERM and SIGHUP let its command save what it has, and raise
    KeyboardInterrupt.
    """
    runner = StepRunner()
    with contextlib.ExitStack() as until_done:
        try:
            until_done.enter_context(only_writer(out))
        except OSError as error:
            raise InputError(f"{out} cannot be written ({error.strerror}).") from None
        for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            handler = signal.getsignal(name)
            until_done.callback(signal.signal, name, handler)
            if handler is not signal.SIG_IGN:
                signal.signal(name, runner.stop)
            elif name == signal.SIGINT:
                # In the background. Commands inherit what is ignored, but not an answer, and have
                # to hear the SIGINT by which `StepRunner.stop` ends them.
                signal.signal(name, lambda number, frame: None)
        yield runner


def is_done(step: Step, folder: Path) -> bool:
    """Test whether a step has finished for its present inputs, and its result is there."""
    noted = read_journal(folder).get(step.name, {})
    same = noted.get("depends_on") == step.depends_on
    return same and bool(noted.get("finished")) and step.result.exists()


def read_journal(folder: Path) -> dict[str, Any]:
    """Entries of `steps.json` by step; empty where nothing has run."""
    path = folder / "steps.json"
    return read_result(path) if path.is_file() else {}


def read_result(path: Path) -> dict[str, Any]:
    """A JSON file that a step left."""
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

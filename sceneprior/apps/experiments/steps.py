"""Runs `sceneprior` commands as steps of an experiment that can be stopped and continued.

Each command is a separate process, so that a reader who doubts a number can run the command again.
The `steps.json` of a folder records the command of each step, its costs and whether it finished.
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
"""Recorded costs of a command, each with the function that combines the cost of a stopped command
with that of its continuation."""


@dataclass(frozen=True)
class Step:
    """A `sceneprior` command, and the conditions under which it has to run."""

    name: str
    arguments: list[str]
    result: Path
    """File that the command writes; a step whose result was deleted runs again."""
    depends_on: list[str]
    """Inputs of the result; the step runs again if they differ from the recorded ones."""
    continues: Path | None = None
    """File from which a stopped command continues; if it exists, the costs are added to those
    recorded before."""


class StepRunner:
    """Runs steps one after the other until it is stopped; made by `open_runner`."""

    def __init__(self) -> None:
        self.stopped = self._calling = False
        self._process: subprocess.Popen[bytes] | None = None

    def stop(self, *signal_and_frame: Any) -> None:
        """Handle a signal to end this process: the running command saves its work, as after
        Ctrl-C, and no further step starts."""
        self.stopped = True
        if not self._calling:
            raise KeyboardInterrupt
        if self._process is not None:
            # `Popen.send_signal` would collect the exit status that wait4 waits for.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGINT)

    def do(
        self, step: Step, folder: Path, log: Path | None = None, unshown: Sequence[str] = ()
    ) -> None:
        """Run a step, record it in `folder`, and drop the records of later steps, now out of date.

        Args:
            log: File for the command's output; None prints it on the terminal.
            unshown: Further arguments, which are neither printed nor recorded.

        Raises:
            InputError: the command failed; the message is the command's own, if `log` holds one.
            KeyboardInterrupt: the runner was stopped; the command's costs so far are recorded.
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
        # The step is recorded without costs until it ends: the costs of a killed command are
        # unknown.
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
        """Run a command to its end; returns its exit status and costs."""
        start = time.monotonic()
        with contextlib.nullcontext() if log is None else log.open("wb") as output:
            self._calling = True
            try:
                self._process = process = subprocess.Popen(
                    [sys.executable, "-m", "sceneprior", *arguments],
                    stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                    process_group=0,  # so that only `stop` passes Ctrl-C on, and only once
                )  # fmt: skip
                if self.stopped:  # a signal came while the process started
                    self.stop()
                # wait4 returns the usage of this child and its descendants only.
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
    """A runner for steps that write to `out`, which it locks against other runners.

    While the runner is open, Ctrl-C, SIGTERM and SIGHUP let the running command save its work, and
    then raise KeyboardInterrupt.
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
                # The signal is ignored, as in a background process. Commands would inherit that,
                # but not a handler, and have to receive the SIGINT of `StepRunner.stop`.
                signal.signal(name, lambda number, frame: None)
        yield runner


def is_done(step: Step, folder: Path) -> bool:
    """True if a step has finished with its current inputs and its result exists."""
    noted = read_journal(folder).get(step.name, {})
    same = noted.get("depends_on") == step.depends_on
    return same and bool(noted.get("finished")) and step.result.exists()


def read_journal(folder: Path) -> dict[str, Any]:
    """Entries of `steps.json` by step; empty if nothing has run."""
    path = folder / "steps.json"
    return read_result(path) if path.is_file() else {}


def read_result(path: Path) -> dict[str, Any]:
    """The contents of a JSON file that a step wrote."""
    try:
        return dict(read_json(path))
    except (InputError, TypeError, ValueError):
        raise InputError(
            f"{path} is damaged; delete it and run the same command again: training is kept."
        ) from None


def failure_reason(log: Path | None, status: int) -> str:
    """The error message of a failed command, or else the last line of its output."""
    if log is None:
        return f"exit status {status}"
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines()]
    errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")]
    told = errors or [line for line in lines if line]
    if status < 0 and not errors:
        return f"killed by {signal.Signals(-status).name}; run the same command again to continue"
    return told[-1] if told else f"it printed nothing to {log}"

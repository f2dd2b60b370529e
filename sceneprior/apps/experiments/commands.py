"""Runs `sceneprior` commands that can be stopped and continued, each in a process of its own.

The `steps.json` of a folder records each command, its costs and whether it finished, so that a
reader who doubts a number can run the command again.
"""

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json, write_json

_STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True)
class Command:
    """A `sceneprior` command, and the conditions under which it has to run."""

    name: str
    arguments: list[str]
    result: Path
    """File that the command writes; a command whose result was deleted runs again."""
    depends_on: list[str]
    """Inputs of the result; the command runs again if they differ from the recorded ones."""
    continues: Path | None = None
    """File from which a stopped command continues; if it exists, the costs are added to those
    recorded before."""


def is_done(command: Command, folder: Path) -> bool:
    """True if a command has finished with its current inputs and its result exists."""
    noted = read_journal(folder).get(command.name, {})
    same = noted.get("depends_on") == command.depends_on
    return same and bool(noted.get("finished")) and command.result.exists()


def run_command(
    command: Command, folder: Path, log: Path | None = None, unshown: Sequence[str] = ()
) -> None:
    """Run a command, record it in `folder`, and drop the records of later ones, now out of date.

    Args:
        log: File for the command's output; None prints it on the terminal.
        unshown: Further arguments, which are neither printed nor recorded.

    Raises:
        InputError: the command failed; the message is the command's own, if `log` holds one.
        KeyboardInterrupt: a signal stopped it; its costs so far are recorded.
    """
    print(f"$ sceneprior {shlex.join(command.arguments)}", file=sys.stderr, flush=True)
    noted = read_journal(folder)
    continued = command.continues is not None and command.continues.exists()
    took = noted.get(command.name, {}) if continued else {"cpu_s": 0.0, "wall_s": 0.0}
    earlier = dict(takewhile(lambda item: item[0] != command.name, noted.items()))
    entry: dict[str, Any] = {"arguments": command.arguments, "depends_on": command.depends_on}
    # Recorded without costs until it ends: the costs of a killed command are unknown.
    write_json(folder / "steps.json", {**earlier, command.name: entry})
    status, costs, stopped = call([*command.arguments, *unshown], log)
    for name in ("cpu_s", "wall_s"):
        entry[name] = None if took.get(name) is None else took[name] + costs[name]
    entry["peak_memory_gib"] = max(took.get("peak_memory_gib") or 0.0, costs["peak_memory_gib"])
    entry["finished"] = status == 0
    write_json(folder / "steps.json", {**earlier, command.name: entry})
    if stopped:
        raise KeyboardInterrupt
    if status:
        raise InputError(failure_reason(log, status))


def call(arguments: Sequence[str], log: Path | None) -> tuple[int, dict[str, float], bool]:
    """Run a command to its end; returns its exit status, its costs, and whether it was stopped.

    Ctrl-C, SIGTERM and SIGHUP reach the command as SIGINT, so that it saves its work.
    """
    running: list[int] = []
    stopped: list[int] = []

    def stop(number: int, frame: Any) -> None:
        stopped.append(number)
        for process_group in running:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process_group, signal.SIGINT)

    def ignore(number: int, frame: Any) -> None:
        """In place of SIG_IGN, which the command would inherit: `stop` has to reach it."""

    start = time.monotonic()
    before = {number: signal.getsignal(number) for number in _STOPPING}
    with contextlib.nullcontext() if log is None else log.open("wb") as output:
        try:
            for number, handler in before.items():
                if handler is not signal.SIG_IGN:
                    signal.signal(number, stop)
                elif number == signal.SIGINT:
                    signal.signal(number, ignore)
            process = subprocess.Popen(
                [sys.executable, "-m", "sceneprior", *arguments],
                stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                process_group=0,  # so that only `stop` passes Ctrl-C on, and only once
            )  # fmt: skip
            running.append(process.pid)
            if stopped:  # a signal came while the process started
                stop(stopped[0], None)
            # wait4 returns the usage of this child and its descendants only.
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
    costs = {
        "cpu_s": used.ru_utime + used.ru_stime,
        "wall_s": time.monotonic() - start,
        "peak_memory_gib": used.ru_maxrss / 2**20,  # KiB; its largest process, or this one
    }
    return process.returncode, costs, bool(stopped)


def read_journal(folder: Path) -> dict[str, Any]:
    """Entries of `steps.json` by command; empty if nothing has run."""
    path = folder / "steps.json"
    return read_result(path) if path.is_file() else {}


def read_result(path: Path) -> dict[str, Any]:
    """The contents of a JSON file that a command wrote."""
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

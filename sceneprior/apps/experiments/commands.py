"""Runs `sceneprior` commands one after the other, so that they can be stopped and continued.

The `steps.json` of a folder records each command, its costs and whether it finished, so that a
reader who doubts a number can run the command again. The demo is such a folder: the whole pipeline
on procedural homes, from homes to a page that lists the commands.
"""

import contextlib
import gc
import importlib
import os
import shlex
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, RootModel

from sceneprior.apps.config import load_config
from sceneprior.core.checked import checked
from sceneprior.core.errors import InputError, sentence_of
from sceneprior.core.files import only_writer, read_json, write_json
from sceneprior.core.settings import as_value

Main = Callable[[list[str]], int | None]
"""The command line: runs a command in this process; returns its exit status."""
STOPPED = 130
"""Exit status of a command after Ctrl-C."""


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


@contextlib.contextmanager
def running_commands(out: Path) -> Iterator[None]:
    """Lock a folder against other runners; SIGTERM and SIGHUP end a command as Ctrl-C does, so that
    it saves its work."""
    with only_writer(out), contextlib.ExitStack() as until_done:
        for number in (signal.SIGTERM, signal.SIGHUP):
            handler = signal.getsignal(number)
            if handler is not signal.SIG_IGN:
                until_done.callback(signal.signal, number, handler)
                signal.signal(number, signal.default_int_handler)
        yield


def run_command(main: Main, command: Command, folder: Path, log: Path | None = None) -> None:
    """Run a command, record it in `folder`, and drop the records of later ones, now out of date.

    Args:
        log: File for the command's output; None prints it on the terminal.

    Raises:
        InputError: the command failed.
        KeyboardInterrupt: it was stopped; its costs so far are recorded.
    """
    print(f"$ sceneprior {shlex.join(command.arguments)}", file=sys.stderr, flush=True)
    noted = read_journal(folder)
    continued = command.continues is not None and command.continues.exists()
    took = noted.get(command.name, {}) if continued else {"cpu_s": 0.0, "wall_s": 0.0}
    earlier = dict(takewhile(lambda item: item[0] != command.name, noted.items()))
    entry: dict[str, Any] = {"arguments": command.arguments, "depends_on": command.depends_on}
    # Recorded without costs until it ends: the costs of a killed command are unknown.
    write_json(folder / "steps.json", {**earlier, command.name: entry})
    start, finished = costs(), False
    try:
        call(main, command.arguments, log)
        finished = True
    finally:
        end = costs()
        for name, before in start.items():
            known = took.get(name) is not None
            entry[name] = took[name] + end[name] - before if known else None
        entry["finished"] = finished
        write_json(folder / "steps.json", {**earlier, command.name: entry})


def call(main: Main, arguments: list[str], log: Path | None) -> None:
    """Run a command; an InputError says why it failed."""
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    with contextlib.ExitStack() as until_done:
        until_done.callback(torch.set_num_threads, threads)  # `fit` may change both
        until_done.callback(torch.set_float32_matmul_precision, precision)
        until_done.callback(gc.collect)  # trainers and networks refer to each other
        if log is not None:
            # Imports Lightning, whose log handlers keep the stderr of then; a log will be closed.
            importlib.import_module("sceneprior.training.fit")
            output = until_done.enter_context(log.open("w"))
            until_done.enter_context(contextlib.redirect_stdout(output))
            until_done.enter_context(contextlib.redirect_stderr(output))
        try:
            status = main(arguments)
        except Exception as error:
            if (sentence := sentence_of(error)) is None:
                traceback.print_exc()
                raise InputError(f"{type(error).__name__}: {error}") from None
            print(f"Error: {sentence}", file=sys.stderr)
            raise InputError(sentence) from None
    if status == STOPPED:  # `fit` saves its work first
        raise KeyboardInterrupt
    if status:
        raise InputError(f"exit status {status}")


def costs() -> dict[str, float]:
    """CPU and wall-clock seconds so far."""
    used = os.times()
    cpu_s = used.user + used.system + used.children_user + used.children_system
    return {"cpu_s": cpu_s, "wall_s": time.monotonic()}


class _Entry(BaseModel, strict=True):
    arguments: list[str] = []
    depends_on: list[str] = []
    cpu_s: float | None = None
    wall_s: float | None = None
    finished: bool = False


class _Journal(RootModel[dict[str, _Entry]]):
    """The contents of `steps.json`, by command."""


def read_journal(folder: Path) -> dict[str, Any]:
    """Entries of `steps.json` by command; empty if nothing has run."""
    path = folder / "steps.json"
    return read_result(path, _Journal) if path.is_file() else {}


def read_result(path: Path, schema: type[BaseModel]) -> dict[str, Any]:
    """The contents of a JSON file that a command wrote."""
    try:
        found: dict[str, Any] = read_json(path)
        checked(schema, found, str(path))
    except InputError:
        raise InputError(
            f"{path} is damaged; delete it and run the same command again: training is kept."
        ) from None
    return found


def finished_commands(folder: Path) -> tuple[list[str], float | None]:
    """The finished commands of `steps.json`, as they are typed, and the seconds that they took;
    None if one was killed, or nothing has run."""
    finished = [entry for entry in read_journal(folder).values() if entry.get("finished")]
    seconds = [entry.get("wall_s") for entry in finished]
    known = seconds and None not in seconds
    typed = [f"sceneprior {shlex.join(entry.get('arguments', []))}" for entry in finished]
    return typed, sum(seconds) if known else None


# -- The demo --------------------------------------------------------------------------------------


def run_demo(out: Path, config: str, rooms: int, count: int, main: Main) -> None:
    """Run every unfinished command.

    Ctrl-C, SIGTERM and SIGHUP raise KeyboardInterrupt; a second, identical call continues.
    """
    with running_commands(out):
        for command in demo_commands(out, config, rooms, count):
            if is_done(command, out):
                took = read_journal(out)[command.name].get("wall_s")
                seconds = "" if took is None else f", {took:.0f} s"
                print(f"{command.name}: done before{seconds}", file=sys.stderr)
                continue
            try:
                run_command(main, command, out)
            except InputError:
                raise InputError(
                    f"The demo stopped at '{command.name}'; fix the error and run it again."
                ) from None


def demo_commands(out: Path, config: str, rooms: int, count: int) -> list[Command]:
    """The demo's commands in order; a command is repeated if its arguments or the contents of
    `config` change."""
    homes, shards, run, scenes = (str(out / name) for name in ("homes", "shards", "run", "scenes"))
    scores, page = str(out / "scores.json"), str(out / "report.html")
    words = {
        "homes": ["make-homes", homes, "--rooms", str(rooms), "--seed", "0"],
        "shards": [
            "prep-front", "--front", f"{homes}/3D-FRONT", "--future", f"{homes}/3D-FUTURE-model",
            "--splits", f"{homes}/splits/bedroom.csv", "--recipe", "bedroom",
            "--out", shards,
        ],
        "fit": [
            "fit", "--config", config, "--run", run, "--set",
            f"data.shards={as_value(shards)}", "--resume",
        ],
        "scenes": ["synthesize", "--run", run, "-n", "16", "--out", scenes, "--overwrite"],
        "scores": ["eval-fid", "--run", run, "-n", str(count), "--out", scores],
        "report": ["report", "--run", run, "--scores", scores, "--out", page],
    }  # fmt: skip
    settings = load_config(config)
    last = settings.stages()[-1].name
    results = {
        "homes": "homes", "shards": "shards/index.json", "fit": f"run/{last}/final.ckpt",
        "scenes": "scenes/overview.png", "scores": "scores.json", "report": "report.html",
    }  # fmt: skip
    continues = {"shards": out / "shards", "fit": out / "run"}
    depends_on = words | {"fit": [*words["fit"], settings.model_dump_json()]}
    return [
        Command(name, arguments, out / results[name], depends_on[name], continues.get(name))
        for name, arguments in words.items()
    ]

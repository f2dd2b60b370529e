"""One run of a comparison in; trained and judged by two commands, with what they took, out."""

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from sceneprior.config import load_any_run, load_config
from sceneprior.errors import InputError
from sceneprior.experiments.comparison import Run
from sceneprior.files import read_json, write_json
from sceneprior.training.checkpoints import read_checkpoint

JOURNAL = "steps.json"
SAY = Console(stderr=True, soft_wrap=True)


@dataclass(frozen=True)
class Manner:
    """How all runs of a comparison are trained and judged."""

    sampling_seed: int
    renderer: str
    inception: Path | None
    accelerator: str

    def training(self, run: Run) -> list[str]:
        """Arguments of `sceneprior` that train a run, or go on with it."""
        settings = [word for setting in run.settings for word in ("--set", setting)]
        # One device: several would share each batch, or train on larger ones.
        return [
            "fit", "--config", run.config, "--run", str(run.folder / "run"), *settings,
            "--logger", "csv", "--accelerator", self.accelerator, "--devices", "1", "--resume",
        ]  # fmt: skip

    def asked(self, count: int) -> list[str]:
        """What scores depend on, beside the run: rows of one table have it in common."""
        # Some methods decode meshes and some have boxes alone: --boxes compares what all have.
        weights = [] if self.inception is None else ["--inception", str(self.inception)]
        return [
            "-n", str(count), "--seed", str(self.sampling_seed), "--boxes",
            "--renderer", self.renderer, *weights,
        ]  # fmt: skip

    def judging(self, run: Run, count: int) -> list[str]:
        """Arguments of `sceneprior` that judge a trained run."""
        paths = ["--run", str(run.folder / "run"), "--out", str(run.folder / "scores.json")]
        return ["eval-fid", *paths, *self.asked(count)]


@dataclass(frozen=True)
class Costs:
    """What training a run took."""

    cpu_s: float | None
    """None where it was killed on the way, or trained by hand: nobody knows."""
    steps: int
    parameters: int


def is_trained(run: Run) -> bool:
    """Whether a run has finished its training, as the comparison wants it now.

    Raises:
        InputError: its folder holds a run of other settings.
    """
    saved = run.folder / "run" / "config.yaml"
    if not saved.is_file():
        return False
    wanted = load_config(run.config, run.settings)
    try:
        same = load_config(str(saved)) == wanted
    except InputError:
        same = False  # of another version, or damaged
    if not same:
        raise InputError(
            f"{run.folder} holds a run of other settings than the comparison now asks for; delete "
            "it to train anew, or name another --out."
        )
    return (run.folder / "run" / wanted.stages()[-1].name / "final.ckpt").is_file()


def is_judged(run: Run, asked: Sequence[str] | None = None) -> bool:
    """Whether there are scores of a trained run; if `asked`, such as these words ask for."""
    noted = _journal(run.folder).get("scores", {})
    there = bool(noted.get("finished")) and (run.folder / "scores.json").is_file()
    return there and (asked is None or noted.get("asked") == list(asked))


def costs_of(run: Run) -> Costs:
    """What training took, from what was noted beside it and from its checkpoints."""
    folder = run.folder / "run"
    trained = load_any_run(folder)
    stages = [stage.name for stage in trained.config.stages()]
    return Costs(
        cpu_s=_journal(run.folder).get("fit", {}).get("cpu_s"),
        steps=sum(_steps_of(folder / stage / "final.ckpt") for stage in stages),
        parameters=sum(item.numel() for item in trained.prior.parameters()),
    )


def _steps_of(final: Path) -> int:
    steps = int(read_checkpoint(final)["global_step"])
    # Lightning counts updates; a GAN makes two a batch.
    return steps // 2 if final.parent.name == "gan" else steps


@dataclass
class Commands:
    """Commands of `sceneprior`, in processes of their own that stop together."""

    threads: int | None
    """A command's share of the cores; None leaves it all of them."""
    stopped: bool = False
    _running: set[subprocess.Popen[bytes]] = field(default_factory=set)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def stop(self) -> None:
        """Begin no more, and let those that run save what they have, as Ctrl-C would."""
        with self._lock:
            self.stopped = True
            for process in self._running:
                # Not Popen's own way, which would take the exit status that wait4 waits for.
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process.pid, signal.SIGINT)

    def call(self, arguments: Sequence[str], log: Path) -> tuple[int, float, float] | None:
        """Exit status, CPU seconds and wall seconds of a command, whose words go to `log`; None
        where all were stopped before it began."""
        share = {}
        if self.threads is not None:
            share = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), str(self.threads))
        start = time.monotonic()
        with log.open("wb") as file:
            with self._lock:
                if self.stopped:
                    return None
                process = subprocess.Popen(
                    [sys.executable, "-m", "sceneprior", *arguments],
                    stdin=subprocess.DEVNULL, stdout=file, stderr=file, env={**os.environ, **share},
                    process_group=0,  # `stop` tells it of a Ctrl-C, and once
                )  # fmt: skip
                self._running.add(process)
            # wait4 knows what this child alone has used, with all that it waited for itself.
            _, status, used = os.wait4(process.pid, 0)
            with self._lock:
                self._running.remove(process)
                process.returncode = os.waitstatus_to_exitcode(status)
        return process.returncode, used.ru_utime + used.ru_stime, time.monotonic() - start

    def train_and_judge(self, run: Run, manner: Manner, count: int) -> str | None:
        """Both commands of a run, unless they are done; a sentence if one failed."""
        try:
            failure = None
            if not is_trained(run):
                failure = self._do("fit", manner.training(run), run)
            if failure is None and not self.stopped and not is_judged(run, manner.asked(count)):
                failure = self._do("scores", manner.judging(run, count), run, manner.asked(count))
        except InputError as error:
            failure = str(error)
        except OSError as error:
            failure = f"{error.filename or run.folder} cannot be written ({error.strerror})"
        return failure and f"{run.rooms}, {run.method}, seed {run.seed}: {failure}"

    def _do(
        self, name: str, arguments: list[str], run: Run, asked: list[str] | None = None
    ) -> str | None:
        if self.stopped:
            return None
        SAY.print(f"$ sceneprior {shlex.join(arguments)}", markup=False, highlight=False)
        noted = _journal(run.folder)
        took = _costs_so_far(noted, run) if name == "fit" else (0.0, 0.0)
        if name == "fit":
            noted.pop("scores", None)  # which were of what lay here before
        entry: dict[str, Any] = {"arguments": arguments, "asked": asked, "finished": False}
        # Without costs, until it ends: those of a run that is killed are unknown.
        write_json(run.folder / JOURNAL, {**noted, name: entry})
        log = run.folder / f"{name}.log"
        ended = self.call(arguments, log)
        status, cpu_s, wall_s = (None, 0.0, 0.0) if ended is None else ended
        sums = [None if a is None else a + b for a, b in zip(took, (cpu_s, wall_s), strict=True)]
        entry |= {"cpu_s": sums[0], "wall_s": sums[1], "finished": status == 0}
        write_json(run.folder / JOURNAL, {**noted, name: entry})
        return _reason(log, status) if status and not self.stopped else None


def _costs_so_far(noted: dict[str, Any], run: Run) -> tuple[float | None, float | None]:
    """CPU and wall seconds of the part of a training that is there already."""
    if not (run.folder / "run" / "config.yaml").is_file():
        return 0.0, 0.0
    before = noted.get("fit", {})
    return before.get("cpu_s"), before.get("wall_s")


def _journal(folder: Path) -> dict[str, Any]:
    path = folder / JOURNAL
    return read_result(path) if path.is_file() else {}


def read_result(path: Path) -> dict[str, Any]:
    """A JSON file of a run.

    Raises:
        InputError: it is damaged.
    """
    try:
        return dict(read_json(path))
    except (InputError, TypeError, ValueError):
        raise InputError(
            f"{path} is damaged; delete it and run the same command again: training is kept."
        ) from None


def _reason(log: Path, status: int) -> str:
    """The sentence a command failed with, or its last words."""
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines()]
    errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")]
    told = errors or [line for line in lines if line]
    if status < 0 and not errors:
        return f"killed by {signal.Signals(-status).name}; the same command goes on"
    return told[-1] if told else f"it said nothing in {log}"

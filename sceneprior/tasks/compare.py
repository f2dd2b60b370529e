"""A comparison in; trained and judged runs, one table and a figure for each kind of room out.

Each run is two commands of `sceneprior`, `fit` and `eval-fid`, in processes of their own: whoever
doubts a figure types them again. What a run cost is noted beside it; finished runs are kept.
"""

import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from sceneprior.evaluation.comparison_table import Row, write_tables
from sceneprior.evaluation.image_metrics import check_inception
from sceneprior.files import write_whole
from sceneprior.offscreen import open_renderer
from sceneprior.stages.runs import STAGES, load_any_run, read_checkpoint
from sceneprior.tasks.comparison import Comparison, Run, runs_of
from sceneprior.tasks.comparison_figure import write_figure

JOURNAL = "steps.json"
SAY = Console(stderr=True, soft_wrap=True)
INTERRUPTED = (130, -signal.SIGINT)


@dataclass(frozen=True)
class Costs:
    """What training a run took."""

    cpu_s: float
    steps: int
    parameters: int


def compare(
    comparison: Comparison,
    part: Comparison,
    out: Path,
    jobs: int,
    renderer: str,
    inception: Path | None = None,
) -> list[str]:
    """Train and judge every run that is not done yet, then write `table.*` and the figures.

    Args:
        comparison: From `load_comparison`; the tables show all of it that is done.
        part: What to do now: from `part_of`, or the same.
        out: `<rooms>/<method>/seed<k>/` in it holds a run; the tables lie beside them.
        jobs: Runs at a time.
        renderer: A renderer's name, or `auto`.
        inception: NVIDIA's `inception-2015-12-05.pt`; None leaves FID out.

    Returns:
        A sentence for each run that failed; the table is written without it.

    Raises:
        KeyboardInterrupt: stopped by Ctrl-C; the same call goes on.
    """
    # Some methods decode meshes and some have boxes alone: --boxes compares what all have.
    judging: tuple[str, ...] = ("--boxes", "--renderer", renderer)
    if inception is not None:
        check_inception(inception)
        judging = (*judging, "--inception", str(inception))
    stop = threading.Event()
    pool = ThreadPoolExecutor(max_workers=jobs)
    failures: list[str | None] = []
    try:
        work = partial(_do, comparison=comparison, judging=judging, jobs=jobs, stop=stop)
        failures = list(pool.map(work, runs_of(part, out)))
    except KeyboardInterrupt:
        stop.set()
    finally:
        pool.shutdown(cancel_futures=True)  # waits for those that the same Ctrl-C has told
    if stop.is_set():
        raise KeyboardInterrupt
    done = [run for run in runs_of(comparison, out) if _is_done(run, comparison, judging)]
    if done:
        write_tables(_rows(comparison, done), out)
        drawing = open_renderer(renderer)
        for key in comparison.rooms:
            first = {run.method: run for run in reversed(done) if run.rooms == key}
            if own := [first[method] for method in comparison.methods if method in first]:
                write_figure(comparison, own, out / f"{key}.png", drawing)
    return [failure for failure in failures if failure]


def _journal(run: Run) -> dict[str, Any]:
    path = run.folder / JOURNAL
    found: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    return found


def _is_done(run: Run, comparison: Comparison, judging: tuple[str, ...]) -> bool:
    noted = _journal(run)
    return all(
        noted.get(name, {}).get("finished") and noted[name]["arguments"] == arguments
        for name, arguments in _steps(run, comparison, judging).items()
    )


def _do(
    run: Run,
    comparison: Comparison,
    judging: tuple[str, ...],
    jobs: int,
    stop: threading.Event,
) -> str | None:
    """Both commands of a run, unless they are done; a sentence if one failed."""
    done = _journal(run)
    for name, arguments in _steps(run, comparison, judging).items():
        before = done.get(name, {})
        if before.get("finished") and before["arguments"] == arguments:
            continue
        if stop.is_set():
            return None
        SAY.print(f"$ sceneprior {shlex.join(arguments)}", markup=False, highlight=False)
        run.folder.mkdir(parents=True, exist_ok=True)
        goes_on = not before.get("finished")
        if name == "fit":
            done.pop("scores", None)  # which were of what lay here before
            goes_on = (run.folder / "run" / "config.yaml").is_file()
        earlier = before if goes_on else {}
        status, cpu_s, wall_s = _call(arguments, run.folder / f"{name}.log", jobs)
        done[name] = {
            "arguments": arguments,
            "cpu_s": cpu_s + earlier.get("cpu_s", 0.0),
            "wall_s": wall_s + earlier.get("wall_s", 0.0),
            "finished": status == 0,
        }
        write_whole(run.folder / JOURNAL, (json.dumps(done, indent=1) + "\n").encode())
        if status in INTERRUPTED:
            stop.set()
            return None
        if status:
            told = _reason(run.folder / f"{name}.log")
            return f"{run.rooms}, {run.method}, seed {run.seed}: {told}"
    return None


def _steps(run: Run, comparison: Comparison, judging: tuple[str, ...]) -> dict[str, list[str]]:
    settings = [word for setting in run.settings for word in ("--set", setting)]
    return {
        "fit": [
            "fit", "--config", run.config, "--run", str(run.folder / "run"), *settings,
            "--logger", "csv", "--resume",
        ],
        "scores": [
            "eval-fid", "--run", str(run.folder / "run"), "-n", str(comparison.count),
            "--seed", str(comparison.sampling_seed), "--out", str(run.folder / "scores.json"),
            *judging,
        ],
    }  # fmt: skip


def _call(arguments: Sequence[str], log: Path, jobs: int) -> tuple[int, float, float]:
    """Exit status, CPU seconds and wall seconds of a command, whose words go to `log`."""
    # Threads of several jobs on one core wait for each other, spinning: each job has its share.
    threads = str(max(1, (os.cpu_count() or 1) // jobs))
    share = {"OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads} if jobs > 1 else {}
    start = time.monotonic()
    with log.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "sceneprior", *arguments],
            stdout=file, stderr=file, env={**os.environ, **share},
        )  # fmt: skip
        # wait4 knows what this child alone has used, with all that it waited for itself.
        _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, used.ru_utime + used.ru_stime, time.monotonic() - start


def _reason(log: Path) -> str:
    """The sentence a command failed with, or its last words."""
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines()]
    errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")]
    told = errors or [line for line in lines if line]
    return told[-1] if told else f"it said nothing in {log}"


def _rows(comparison: Comparison, done: Sequence[Run]) -> list[Row]:
    rows = []
    for run in done:
        scores = json.loads((run.folder / "scores.json").read_text())
        method = comparison.methods[run.method]
        rows.append(
            Row(
                rooms=comparison.rooms[run.rooms].title,
                group=method.group,
                title=method.title,
                seed=run.seed,
                scores=scores,
                costs=vars(costs_of(run.folder)),
            )
        )
    return rows


def costs_of(folder: Path) -> Costs:
    """What training took, from what `compare` noted and the checkpoints hold."""
    run = folder / "run"
    finals = [path for stage in STAGES if (path := run / stage / "final.ckpt").is_file()]
    noted = json.loads((folder / JOURNAL).read_text())
    return Costs(
        cpu_s=noted["fit"]["cpu_s"],
        steps=sum(_steps_of(path) for path in finals),
        parameters=sum(item.numel() for item in load_any_run(run).prior.parameters()),
    )


def _steps_of(final: Path) -> int:
    steps = int(read_checkpoint(final)["global_step"])
    # Lightning counts updates; a GAN makes two a batch.
    return steps // 2 if final.parent.name == "gan" else steps

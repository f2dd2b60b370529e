"""A comparison in; trained and judged runs, one table and a figure for each kind of room out.

Each run is two commands of `sceneprior`, `fit` and `eval-fid`, in processes of their own: whoever
doubts a figure types them again. What a run cost is noted beside it; finished runs are kept.
"""

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from sceneprior.config import load_config
from sceneprior.errors import InputError
from sceneprior.evaluation.networks import check_inception
from sceneprior.experiments.comparison import Comparison, Run, runs_of
from sceneprior.experiments.figure import write_figure
from sceneprior.experiments.steps import (
    Commands,
    Manner,
    costs_of,
    is_judged,
    is_trained,
    read_result,
)
from sceneprior.experiments.table import Row, write_tables
from sceneprior.files import only_writer
from sceneprior.offscreen import open_renderer
from sceneprior.shards import iterate_rooms


@dataclass(frozen=True)
class Compared:
    """What a call of `compare` came to."""

    table: Path | None
    """None where no run is done."""
    failures: list[str]
    """A sentence for each run that failed; the table is written without it."""
    left_out: list[str]
    """Runs that are done, but were judged otherwise than the table's."""


def compare(
    comparison: Comparison,
    part: Comparison,
    out: Path,
    jobs: int,
    renderer: str,
    inception: Path | None = None,
    accelerator: str = "auto",
) -> Compared:
    """Train and judge every run that is not done yet, then write `table.*` and the figures.

    Args:
        comparison: From `load_comparison`; the tables show all of it that is done.
        part: What to do now: from `part_of`, or the same.
        out: `<rooms>/<method>/seed<k>/` in it holds a run; the tables lie beside them.
        jobs: Runs at a time.
        renderer: A renderer's name, or `auto`.
        inception: NVIDIA's `inception-2015-12-05.pt`; None leaves FID out.
        accelerator: That trains the runs, one device each: Lightning's word.

    Raises:
        InputError: shards are missing, another `compare` is writing to `out`, or the renderer or
            the weights cannot be used.
        KeyboardInterrupt: stopped by Ctrl-C, SIGTERM or SIGHUP; the same call goes on.
    """
    if inception is not None:
        check_inception(inception)
    drawing = open_renderer(renderer)
    counts = {key: _count(comparison, key) for key in part.rooms}
    manner = Manner(comparison.sampling_seed, renderer, inception, accelerator)
    # Threads of several jobs on one core wait for each other, spinning: each job has its share.
    commands = Commands(max(1, (os.cpu_count() or 1) // jobs) if jobs > 1 else None)
    failures: list[str | None] = []
    with _alone_in(out), _ended_as_by_ctrl_c(), ThreadPoolExecutor(max_workers=jobs) as pool:

        def work(run: Run) -> str | None:
            return commands.train_and_judge(run, manner, counts[run.rooms])

        try:
            failures = list(pool.map(work, runs_of(part, out)))
        finally:
            commands.stop()  # what still runs, after Ctrl-C or a fault of ours
        judged = [run for run in runs_of(comparison, out) if is_judged(run) and _is_trained(run)]
        counts |= {key: _count(comparison, key) for key in {run.rooms for run in judged}}
        done = [run for run in judged if is_judged(run, manner.asked(counts[run.rooms]))]
        if done:
            write_tables(_rows(comparison, done), out)
        for key in comparison.rooms:
            first = {run.method: run for run in reversed(done) if run.rooms == key}
            if own := [first[method] for method in comparison.methods if method in first]:
                write_figure(comparison, own, counts[key], out / f"{key}.png", drawing)
    return Compared(
        out / "table.md" if done else None,
        [failure for failure in failures if failure],
        [f"{run.rooms}, {run.method}, seed {run.seed}" for run in judged if run not in done],
    )


def _count(comparison: Comparison, rooms: str) -> int:
    """How many rooms each run generates."""
    if comparison.count is not None:
        return comparison.count
    shards = Path(load_config(comparison.rooms[rooms].config).data.shards)
    return sum(1 for _ in iterate_rooms(shards, "train"))


def _is_trained(run: Run) -> bool:
    try:
        return is_trained(run)
    except InputError:
        return False  # of other settings: no row of this comparison


@contextmanager
def _alone_in(out: Path) -> Iterator[None]:
    with ExitStack() as until_done:
        try:
            until_done.enter_context(only_writer(out))
        except OSError as error:
            raise InputError(f"{out} cannot be written ({error.strerror}).") from None
        yield


@contextmanager
def _ended_as_by_ctrl_c() -> Iterator[None]:
    """Whatever asks this process to end: the commands, which it does not reach, must save."""
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
            # hear the SIGINT by which `Commands.stop` ends them.
            signal.signal(name, lambda number, frame: None)
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(name, handler)


def _rows(comparison: Comparison, done: Sequence[Run]) -> list[Row]:
    rows = []
    for run in done:
        method = comparison.methods[run.method]
        rows.append(
            Row(
                rooms=comparison.rooms[run.rooms].title,
                group=method.group,
                title=method.title,
                seed=run.seed,
                scores=read_result(run.folder / "scores.json"),
                costs=vars(costs_of(run)),
            )
        )
    return rows

"""Trains and evaluates the runs of a comparison, and writes its tables and pictures.

A run is a `fit` and the commands that score it; what is done is kept.
"""

from dataclasses import dataclass
from pathlib import Path

from sceneprior.config import load_config
from sceneprior.errors import InputError
from sceneprior.evaluation.networks import check_inception
from sceneprior.experiments.comparison import (
    Comparison,
    RoomComparison,
    Run,
    ViewComparison,
    runs_of,
)
from sceneprior.experiments.new_rooms import NewRooms
from sceneprior.experiments.single_views import SingleViews
from sceneprior.experiments.steps import Step, is_done, open_runner
from sceneprior.experiments.table import write_tables
from sceneprior.experiments.task import CompareOptions, Task
from sceneprior.offscreen import open_renderer


@dataclass(frozen=True)
class Compared:
    """What a call of `compare` came to."""

    table: Path | None
    """None where no run is done."""
    failures: list[str]
    """A sentence for each run that failed; the table is written without it."""
    left_out: list[str]
    """Runs that are done, but were evaluated otherwise than the table's."""


def compare(
    comparison: Comparison, part: Comparison, out: Path, options: CompareOptions
) -> Compared:
    """Train and evaluate every run that is not done yet, then write `table.*` and the figures.

    Args:
        comparison: The tables show all of it that is done.
        part: What to do now: from `part_of`, or the same.
        out: `<rooms>/<method>/seed<k>/` in it holds a run; the tables lie beside them.

    Raises:
        InputError: of shards, renderer or weights, or another `compare` is writing to `out`.
        KeyboardInterrupt: stopped by Ctrl-C, SIGTERM or SIGHUP; the same call goes on.
    """
    if options.inception is not None:
        check_inception(options.inception)
    renderer = open_renderer(options.renderer)

    task = task_of(comparison, options)

    def train_and_evaluate(run: Run) -> str | None:
        try:
            if not keeps_settings(run):
                raise InputError(
                    f"{run.folder} holds a run of other settings than the comparison now asks "
                    "for; delete it to train anew, or name another --out."
                )
            for step in (training_step(run, options), *task.scoring(run)):
                if not is_done(step, run.folder):
                    runner.do(step, run.folder, run.folder / f"{step.name}.log")
        except InputError as error:
            return f"{run.title}: {error}"
        except OSError as error:
            where = error.filename or run.folder
            return f"{run.title}: {where} cannot be written ({error.strerror})"
        return None

    for rooms in part.rooms:
        task.check(rooms)
    with open_runner(out, options.jobs) as runner:
        failures = list(runner.pool.map(train_and_evaluate, runs_of(part, out)))
        evaluated = [
            run
            for run in runs_of(comparison, out)
            if (run.folder / "scores.json").is_file()
            and keeps_settings(run)
            and is_done(training_step(run, options), run.folder)
            and is_done(task.scoring(run)[0], run.folder, as_asked=False)
        ]
        done = [
            run for run in evaluated if all(is_done(step, run.folder) for step in task.scoring(run))
        ]
        if done:
            write_tables([row for run in done for row in task.rows(run)], out, task.form)
        for key in comparison.rooms:
            first = {run.method: run for run in reversed(done) if run.rooms == key}
            if own := [first[method] for method in comparison.methods if method in first]:
                task.draw(key, own, out / f"{key}.png", renderer)
    return Compared(
        out / "table.md" if done else None,
        [failure for failure in failures if failure],
        [run.title for run in evaluated if run not in done],
    )


def task_of(comparison: Comparison, options: CompareOptions) -> Task:
    """How the runs of a comparison are scored."""
    if isinstance(comparison, ViewComparison):
        return SingleViews(comparison, options)
    assert isinstance(comparison, RoomComparison), "one of TASKS"
    return NewRooms(comparison, options)


def training_step(run: Run, options: CompareOptions) -> Step:
    """`fit` of a run; it is never redone for other settings, but refused (`keeps_settings`)."""
    folder = run.folder / "run"
    settings = [word for setting in run.settings for word in ("--set", setting)]
    last = load_config(run.config, run.settings).stage_names[-1]
    return Step(
        "fit",
        # One device: several would share each batch, or train on larger ones.
        [
            "fit", "--config", run.config, "--run", str(folder), *settings, "--logger", "csv",
            "--accelerator", options.accelerator, "--devices", "1", "--resume",
        ],
        result=folder / last / "final.ckpt",
        depends_on=[],
        continues=folder / "config.yaml",
    )  # fmt: skip


def keeps_settings(run: Run) -> bool:
    """Whether a run's folder is free, or holds a run of the settings that are wanted now."""
    saved = run.folder / "run" / "config.yaml"
    if not saved.is_file():
        return True
    wanted = load_config(run.config, run.settings).with_label_set()
    try:
        return load_config(str(saved)) == wanted
    except InputError:
        return False  # of another version, or damaged

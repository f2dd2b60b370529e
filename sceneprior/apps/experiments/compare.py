"""Trains and evaluates the runs of a comparison, and writes its tables.

A run consists of `fit` and the commands that score it. Finished commands are not repeated.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from sceneprior.apps.config import load_config
from sceneprior.apps.experiments.commands import (
    Command,
    Main,
    is_done,
    run_command,
    running_commands,
)
from sceneprior.apps.experiments.comparison import Comparison, RoomComparison, ViewComparison
from sceneprior.apps.experiments.runs import Run, runs_of, shards_of, variants_of
from sceneprior.apps.experiments.table import write_tables
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import known_in_3d
from sceneprior.core.shards import iterate_rooms
from sceneprior.evaluation.features import check_inception

OF_SHARDS = "shards"
"""Value of `cad_models` that selects the CAD models of the training rooms."""


class Compared(NamedTuple):
    """Outcome of a call of `compare`."""

    table: Path | None
    """File of the table; None if no run is done."""
    failures: list[str]
    """A sentence for each run that failed; the table is written without it."""
    left_out: list[str]
    """Titles of runs that were trained or evaluated with other settings than the runs in the
    table."""


def compare(
    comparison: Comparison,
    part: Sequence[Run],
    out: Path,
    main: Main,
    inception: Path | None = None,
    accelerator: str = "auto",
) -> Compared:
    """Finish the runs of `part` (those of `runs_of`), then write the tables of all finished runs.

    The folder of a run is `<out>/<rooms>/<method>/seed<k>/`; tables are written to `out`. Ctrl-C,
    SIGTERM and SIGHUP raise KeyboardInterrupt; a second, identical call continues.

    Args:
        inception: NVIDIA's `inception-2015-12-05.pt`; None leaves FID out.
        accelerator: Lightning's name of the accelerator; each run is trained on one device.
    """
    if inception is not None:
        check_inception(inception)
    count = cache(lambda rooms: count_of(comparison, rooms))
    for run in part:
        count(run.rooms)  # unusable shards raise here, before anything is trained
    done, failures, left_out = list[Run](), list[str](), list[str]()
    with running_commands(out):
        for run in runs_of(comparison, out):
            evaluated = (run.folder / "scores.json").is_file()
            if run not in part and not evaluated:
                continue
            commands = commands_of(comparison, run, count(run.rooms), inception, accelerator)
            if run in part and (failure := _finish(run, commands, main)):
                failures.append(f"{run.title}: {failure}")
            elif keeps_settings(run) and all(is_done(each, run.folder) for each in commands):
                done.append(run)
            elif evaluated:
                left_out.append(run.title)
        if done:
            write_tables(comparison, done, out)
    return Compared(out / "table.md" if done else None, failures, left_out)


def _finish(run: Run, commands: list[Command], main: Main) -> str | None:
    """Run the unfinished commands of a run; returns a sentence if one fails, else None."""
    if not keeps_settings(run):
        return (
            f"{run.folder} holds a run with other settings than those of the comparison; "
            "delete it to train again, or name another --out."
        )
    try:
        for command in commands:
            if not is_done(command, run.folder):
                run_command(main, command, run.folder, run.folder / f"{command.name}.log")
    except InputError as error:
        return str(error)
    except OSError as error:
        return f"{error.filename or run.folder} cannot be written ({error.strerror})"
    return None


def keeps_settings(run: Run) -> bool:
    """True if a run's folder is free, or holds a run that was trained with the run's settings.

    The section `sampling` is not compared: it has no effect on training, and rows name the
    distribution.
    """
    saved = run.folder / "run" / "config.yaml"
    if not saved.is_file():
        return True
    wanted = run.run_config.with_label_set()
    try:
        kept = load_config(str(saved))
    except InputError:
        return False  # written by another version, or damaged
    return kept.model_dump(exclude={"sampling"}) == wanted.model_dump(exclude={"sampling"})


def count_of(comparison: Comparison, rooms: str) -> int | None:
    """Number of rooms that each run generates, or of test rooms whose views each run reconstructs.

    None means all test rooms. Raises InputError if single views are compared and the test rooms
    have no 3D ground truth.
    """
    shards = shards_of(comparison, rooms)
    if isinstance(comparison, ViewComparison):
        if not known_in_3d(shards, "test"):
            raise InputError(
                f"Single views are compared with true rooms, and the 'test' rooms of {shards} are "
                "missing or not known in 3D; give shards of prep-front or prep-scannet."
            )
        return comparison.count
    assert isinstance(comparison, RoomComparison), "one of TASKS"
    return comparison.count or sum(1 for _ in iterate_rooms(shards, "train"))


def commands_of(
    comparison: Comparison,
    run: Run,
    count: int | None,
    inception: Path | None = None,
    accelerator: str = "auto",
) -> list[Command]:
    """The commands of a run: `fit`, and for each of its variants `eval-fid` or `eval-svr`, which
    depends on the settings that all rows of a table share."""
    shards = str(shards_of(comparison, run.rooms))
    source = ["--run", str(run.folder / "run")]
    shared = ["--seed", str(comparison.sampling_seed)]
    if isinstance(comparison, ViewComparison):
        command, option = "eval-svr", "--fit"
        source += ["--shards", shards]
        shared = ["--split", "test", "--views", str(comparison.views), *shared]
        if count is not None:
            shared += ["--limit", str(count)]
        if (models := comparison.cad_models) is not None:
            shared += ["--models", shards if models == OF_SHARDS else models]
    else:
        command, option = "eval-fid", "--distribution"
        # Some methods decode meshes, others boxes only; --boxes compares the boxes of all methods.
        shared = ["-n", str(count), *shared, "--boxes"]
        if inception is not None:
            shared += ["--inception", str(inception)]
    commands = [_fit(run, accelerator)]
    for variant in variants_of(comparison, run):
        asked = shared if variant.name is None else [*shared, option, variant.name]
        words = [command, *source, "--out", str(variant.result), *asked]
        commands.append(Command(variant.result.stem, words, variant.result, asked))
    return commands


def _fit(run: Run, accelerator: str) -> Command:
    folder = run.folder / "run"
    settings = [word for setting in run.settings for word in ("--set", setting)]
    words = ["fit", "--config", run.config, "--run", str(folder), *settings, "--logger", "csv"]
    # One device, because several would split each batch, or train on larger batches.
    words += ["--accelerator", accelerator, "--devices", "1", "--resume"]
    result = folder / run.run_config.stage_names[-1] / "final.ckpt"
    # It depends on nothing, because changed settings never repeat it: `keeps_settings` refuses.
    return Command("fit", words, result, depends_on=[], continues=folder / "config.yaml")

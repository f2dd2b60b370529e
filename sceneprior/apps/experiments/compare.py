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
from sceneprior.apps.experiments.comparison import (
    Comparison,
    Run,
    ViewComparison,
    runs_of,
    shards_of,
    variants_of,
)
from sceneprior.apps.experiments.rows import form_of, rows_of
from sceneprior.apps.experiments.table import write_tables
from sceneprior.core.errors import InputError
from sceneprior.evaluation.features import check_inception


def part_of(
    comparison: Comparison,
    out: Path,
    methods: str | None = None,
    rooms: str | None = None,
    seeds: str | None = None,
) -> list[Run]:
    """The runs of the given methods, kinds of rooms and seeds, each as `a,b`; None means all."""
    runs = runs_of(comparison, out)
    for what, key, given, known in (
        ("method", "method", methods, comparison.methods),
        ("kind of rooms", "rooms", rooms, comparison.rooms),
        ("seed", "seed", seeds, map(str, comparison.seeds)),
    ):
        names = list(known)
        asked = [name.strip() for name in (",".join(names) if given is None else given).split(",")]
        asked = [name for name in asked if name]
        for name in asked:
            if name not in names:
                raise InputError(
                    f"No {what} '{name}' in this comparison; it has {', '.join(names)}."
                )
        if not asked:
            raise InputError(f"No {what} was named; the comparison has {', '.join(names)}.")
        runs = [run for run in runs if str(getattr(run, key)) in asked]
    return runs


class Compared(NamedTuple):
    """Outcome of a call of `compare`."""

    table: Path | None
    """File of the table; None if no run is done."""
    failures: list[str]
    """A sentence for each run that failed; the table is written without it."""
    left_out: list[str]
    """Titles of runs that were trained or evaluated with other settings than those in the table."""


def compare(
    comparison: Comparison,
    part: Sequence[Run],
    out: Path,
    main: Main,
    inception: Path | None = None,
    accelerator: str | None = None,
) -> Compared:
    """Finish the runs of `part` (those of `runs_of`), then write the tables of all finished runs.

    The folder of a run is `<out>/<rooms>/<method>/seed<k>/`; tables are written to `out`. Ctrl-C,
    SIGTERM and SIGHUP raise KeyboardInterrupt; a second, identical call continues.

    Args:
        inception: NVIDIA's `inception-2015-12-05.pt`; None leaves FID out.
        accelerator: Lightning's name for it (default: the config's); each run uses one device.
    """
    if inception is not None:
        check_inception(inception)
    shared = cache(lambda rooms: comparison.shared_options(shards_of(comparison, rooms), inception))
    for run in part:
        shared(run.rooms)  # unusable shards raise here, before anything is trained
    done, failures, left_out = list[Run](), list[str](), list[str]()
    with running_commands(out):
        for run in runs_of(comparison, out):
            evaluated = (run.folder / "scores.json").is_file()
            if run not in part and not evaluated:
                continue
            commands = commands_of(comparison, run, shared(run.rooms), accelerator)
            if run in part and (failure := _finish(run, commands, main)):
                failures.append(f"{run.title}: {failure}")
            elif keeps_settings(run) and all(is_done(each, run.folder) for each in commands):
                done.append(run)
            elif evaluated:
                left_out.append(run.title)
        if done:
            rows = [row for run in done for row in rows_of(comparison, run)]
            write_tables(rows, form_of(comparison), out)
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


def commands_of(
    comparison: Comparison, run: Run, shared: list[str], accelerator: str | None = None
) -> list[Command]:
    """The commands of a run: `fit`, and for each of its variants the one that scores it, which
    depends on `shared` (`shared_options`)."""
    folder = run.folder / "run"
    settings = [word for setting in run.settings for word in ("--set", setting)]
    words = ["fit", "--config", run.config, "--run", str(folder), *settings, "--logger", "csv"]
    # One device, because several would split each batch, or train on larger batches.
    device = ["--accelerator", accelerator] if accelerator else []
    words += [*device, "--devices", "1", "--resume"]
    result = folder / run.run_config.stage_names[-1] / "final.ckpt"
    # It depends on nothing, because changed settings never repeat it: `keeps_settings` refuses.
    commands = [Command("fit", words, result, depends_on=[], continues=folder / "config.yaml")]
    source = ["--run", str(folder)]
    if isinstance(comparison, ViewComparison):
        source += ["--shards", str(shards_of(comparison, run.rooms))]
    for variant in variants_of(comparison, run):
        asked = shared if variant.name is None else [*shared, comparison.option, variant.name]
        command = comparison.command
        if variant.cad:  # metrics of pictures only, and boxes are those of the variant without
            command, models = "eval-fid", comparison.models(shards_of(comparison, run.rooms))
            asked = [*(word for word in asked if word != "--boxes"), *models]
        words = [command, *source, "--out", str(variant.result), *asked]
        commands.append(Command(variant.result.stem, words, variant.result, asked))
    return commands

"""Trains and evaluates the runs of a comparison, and writes its tables.

A run consists of `fit` and the commands that score it; for existing scenes, of the scoring commands
alone. Finished commands are not repeated.
"""

import hashlib
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from sceneprior.apps.config import load_config
from sceneprior.apps.experiments.comparison import (
    Comparison,
    RoomComparison,
    Run,
    ViewComparison,
    runs_of,
    shards_of,
    variants_of,
)
from sceneprior.apps.experiments.rows import rows_of
from sceneprior.apps.experiments.steps import Step, StepRunner, is_done, open_runner
from sceneprior.apps.experiments.table import NEW_ROOMS, VIEWS, write_tables
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import known_in_3d
from sceneprior.core.shards import iterate_rooms
from sceneprior.evaluation.networks import check_inception

OF_SHARDS = "shards"
"""Value of `cad_models` that selects the CAD models of the training rooms."""


@dataclass(frozen=True)
class CompareOptions:
    """Options for training and evaluating all runs of a comparison."""

    inception: Path | None = None
    """NVIDIA's `inception-2015-12-05.pt`; None leaves FID out."""
    accelerator: str = "auto"
    """Lightning's name of the accelerator; each run is trained on one device."""


@dataclass(frozen=True)
class Compared:
    """Outcome of a call of `compare`."""

    table: Path | None
    """File of the table; None if no run is done."""
    failures: list[str]
    """A sentence for each run that failed; the table is written without it."""
    left_out: list[str]
    """Titles of runs that were trained or evaluated with other settings than the runs in the
    table."""


def compare(
    comparison: Comparison, part: Comparison, out: Path, options: CompareOptions
) -> Compared:
    """Finish the runs of `part`, then write the tables of all finished runs.

    The folder of a run is `<out>/<rooms>/<method>/seed<k>/`; tables are written to `out`. Ctrl-C,
    SIGTERM and SIGHUP raise KeyboardInterrupt; a second, identical call continues.
    """
    if options.inception is not None:
        check_inception(options.inception)
    count = cache(partial(count_of, comparison))
    for rooms in part.rooms:
        count(rooms)  # unusable shards raise here, before anything is trained
    asked, done, failures, left_out = runs_of(part, out), [], [], []
    with open_runner(out) as runner:
        for run in runs_of(comparison, out):
            if run not in asked and not (run.folder / "scores.json").is_file():
                continue
            steps = steps_of(comparison, run, count(run.rooms), options)
            if run in asked and (failure := _do(runner, run, steps)):
                failures.append(f"{run.title}: {failure}")
            elif keeps_settings(run) and all(is_done(step, run.folder) for step in steps):
                done.append(run)
            elif (run.folder / "scores.json").is_file():
                left_out.append(run.title)
        if done:
            form = VIEWS if isinstance(comparison, ViewComparison) else NEW_ROOMS
            write_tables([row for run in done for row in rows_of(comparison, run)], out, form)
    return Compared(out / "table.md" if done else None, failures, left_out)


def _do(runner: StepRunner, run: Run, steps: list[Step]) -> str | None:
    """Run the unfinished steps of a run; returns a sentence if one fails, else None."""
    try:
        if not keeps_settings(run):
            raise InputError(
                f"{run.folder} holds a run with other settings than those of the comparison; "
                "delete it to train again, or name another --out."
            )
        for step in steps:
            if not is_done(step, run.folder):
                runner.do(step, run.folder, run.folder / f"{step.name}.log")
    except InputError as error:
        return str(error)
    except OSError as error:
        return f"{error.filename or run.folder} cannot be written ({error.strerror})"
    return None


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


def steps_of(
    comparison: Comparison, run: Run, count: int | None, options: CompareOptions
) -> list[Step]:
    """The commands of a run: `fit`, unless the run is a folder of scenes, and its scoring steps."""
    scoring = scoring_steps(comparison, run, count, options)
    if run.scenes is not None:
        return scoring
    folder = run.folder / "run"
    settings = [word for setting in run.settings for word in ("--set", setting)]
    last = run.run_config.stage_names[-1]
    # One device, because several would split each batch, or train on larger batches.
    device = ["--accelerator", options.accelerator, "--devices", "1"]
    words = ["fit", "--config", run.config, "--run", str(folder), *settings, "--logger", "csv"]
    fit = Step(
        "fit",
        [*words, *device, "--resume"],
        result=folder / last / "final.ckpt",
        depends_on=[],  # changed settings never repeat `fit`: `keeps_settings` refuses the run
        continues=folder / "config.yaml",
    )
    return [fit, *scoring]


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


def scoring_steps(
    comparison: Comparison, run: Run, count: int | None, options: CompareOptions
) -> list[Step]:
    """`eval-fid` or `eval-svr` of a run, once for each of the run's variants.

    These steps depend on the settings that all rows of a table share.
    """
    shards, state = str(shards_of(comparison, run.rooms)), []
    source = ["--run", str(run.folder / "run")]
    seed = ["--seed", str(comparison.sampling_seed)]
    if isinstance(comparison, ViewComparison):
        command, option = "eval-svr", "--fit"
        source += ["--shards", shards]
        alike = ["--split", "test", "--views", str(comparison.views), *seed]
        if count is not None:
            alike += ["--limit", str(count)]
        if (models := comparison.cad_models) is not None:
            alike += ["--models", shards if models == OF_SHARDS else models]
    else:
        command, option = "eval-fid", "--distribution"
        if run.scenes is not None:
            source, state = ["--scenes", str(run.scenes), "--shards", shards], [_state(run.scenes)]
        # Some methods decode meshes, others boxes only; --boxes compares the boxes of all methods.
        alike = ["-n", str(count), *seed, "--boxes"]
        if options.inception is not None:
            alike += ["--inception", str(options.inception)]
    steps = []
    for variant in variants_of(comparison, run):
        asked = alike if variant.name is None else [*alike, option, variant.name]
        words = [command, *source, "--out", str(variant.result), *asked]
        steps.append(Step(variant.result.stem, words, variant.result, depends_on=asked + state))
    return steps


def _state(scenes: Path) -> str:
    """A fingerprint of a folder of scenes that changes with its files; the files are not read."""
    files = sorted(path for path in scenes.glob("*") if path.suffix in (".json", ".glb"))
    found = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    return hashlib.sha256(repr((str(scenes), found)).encode()).hexdigest()

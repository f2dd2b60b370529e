"""Trains and evaluates the runs of a comparison, and writes its tables and pictures.

A run is a `fit` and an `eval-fid` for each distribution of latents; what is done is kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from sceneprior.config import load_any_run, load_config
from sceneprior.errors import InputError
from sceneprior.evaluation.networks import check_inception
from sceneprior.experiments.comparison import Comparison, Run, distributions_of, runs_of
from sceneprior.experiments.figure import write_figure
from sceneprior.experiments.steps import Step, is_done, open_runner, read_journal, read_result
from sceneprior.experiments.table import Row, write_tables
from sceneprior.offscreen import open_renderer
from sceneprior.shards import iterate_rooms
from sceneprior.training.checkpoints import read_checkpoint


@dataclass(frozen=True)
class CompareOptions:
    """How all runs of a comparison are trained and evaluated."""

    renderer: str = "auto"
    inception: Path | None = None
    """NVIDIA's `inception-2015-12-05.pt`; None leaves FID out."""
    accelerator: str = "auto"
    """That trains the runs, one device each: Lightning's word."""
    jobs: int = 1
    """Runs at a time."""


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

    @cache
    def count(rooms: str) -> int:
        """How many rooms each run generates."""
        shards = Path(load_config(comparison.rooms[rooms].config).data.shards)
        return comparison.count or sum(1 for _ in iterate_rooms(shards, "train"))

    def scoring(run: Run) -> list[Step]:
        return scoring_steps(comparison, run, count(run.rooms), options)

    def train_and_evaluate(run: Run) -> str | None:
        try:
            if not keeps_settings(run):
                raise InputError(
                    f"{run.folder} holds a run of other settings than the comparison now asks "
                    "for; delete it to train anew, or name another --out."
                )
            for step in (training_step(run, options), *scoring(run)):
                if not is_done(step, run.folder):
                    runner.do(step, run.folder, run.folder / f"{step.name}.log")
        except InputError as error:
            return f"{run.title}: {error}"
        except OSError as error:
            where = error.filename or run.folder
            return f"{run.title}: {where} cannot be written ({error.strerror})"
        return None

    for rooms in part.rooms:
        count(rooms)
    with open_runner(out, options.jobs) as runner:
        failures = list(runner.pool.map(train_and_evaluate, runs_of(part, out)))
        evaluated = [
            run
            for run in runs_of(comparison, out)
            if (run.folder / "scores.json").is_file()
            and keeps_settings(run)
            and is_done(training_step(run, options), run.folder)
            and is_done(scoring(run)[0], run.folder, as_asked=False)
        ]
        done = [run for run in evaluated if all(is_done(step, run.folder) for step in scoring(run))]
        if done:
            rows = [_rows(comparison, run, [step.result for step in scoring(run)]) for run in done]
            write_tables([row for rows_of_run in rows for row in rows_of_run], out)
        for key in comparison.rooms:
            first = {run.method: run for run in reversed(done) if run.rooms == key}
            if own := [first[method] for method in comparison.methods if method in first]:
                write_figure(comparison, own, count(key), out / f"{key}.png", renderer)
    return Compared(
        out / "table.md" if done else None,
        [failure for failure in failures if failure],
        [run.title for run in evaluated if run not in done],
    )


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


def scoring_steps(
    comparison: Comparison, run: Run, count: int, options: CompareOptions
) -> list[Step]:
    """`eval-fid` of a trained run, once for each distribution of its latents.

    They depend on what the rows of one table have in common.
    """
    weights = [] if options.inception is None else ["--inception", str(options.inception)]
    # Some methods decode meshes and some have boxes alone: --boxes compares what all have.
    alike = ["-n", str(count), "--seed", str(comparison.sampling_seed), "--boxes"]
    alike += ["--renderer", options.renderer, *weights]
    steps = []
    for number, distribution in enumerate(distributions_of(comparison, run)):
        name = f"scores_{distribution}" if number else "scores"
        scores = run.folder / f"{name}.json"
        asked = alike if distribution is None else [*alike, "--distribution", distribution]
        paths = ["--run", str(run.folder / "run"), "--out", str(scores)]
        steps.append(Step(name, ["eval-fid", *paths, *asked], result=scores, depends_on=asked))
    return steps


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


def costs_of(run: Run) -> dict[str, float | None]:
    """What training took: `cpu_s`, `steps` and `parameters`.

    CPU seconds are None where training was killed on the way, or done by hand: nobody knows.
    """
    steps = 0
    for final in (run.folder / "run").glob("*/final.ckpt"):
        saved = read_checkpoint(final)
        # Lightning counts updates; two networks that train each other make two a batch.
        steps += saved["global_step"] // len(saved["optimizer_states"])
    return {
        "cpu_s": read_journal(run.folder).get("fit", {}).get("cpu_s"),
        "steps": steps,
        "parameters": sum(
            item.numel() for item in load_any_run(run.folder / "run").prior.parameters()
        ),
    }


def _rows(comparison: Comparison, run: Run, results: Sequence[Path]) -> list[Row]:
    """A row for each distribution of latents, and one of decoded training rooms where there are
    some; what training took stands in the first."""
    method = comparison.methods[run.method]
    first = Row(
        rooms=comparison.rooms[run.rooms].title,
        group=method.group,
        title=method.title,
        latents="",
        seed=run.seed,
        scores={},
        costs=costs_of(run),
    )
    rows: list[Row] = []
    for path in results:
        scores = read_result(path)
        latents = scores["protocol"]["latents"]
        rows.append(
            replace(first, latents=latents, scores=scores, costs={} if rows else first.costs)
        )
    if decoded := rows[0].scores.get("decoded_rooms"):
        scores = {**decoded, "protocol": rows[0].scores["protocol"]}
        rows.append(replace(first, latents="of training rooms, decoded", scores=scores, costs={}))
    return rows

"""Commands that train: fit, report, and those that run many others, compare and demo."""

import pkgutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from sceneprior.apps.cli import options
from sceneprior.core.errors import InputError


def fit(
    config: Annotated[str, typer.Option(help="Config: a YAML file, or a shipped one (demo.yaml).")],
    run: Annotated[
        Path | None, typer.Option(help="Folder for checkpoints and logs (default: runs/<config>).")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Changed key: model.width=256; repeatable.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a stopped run.")] = False,
    logger: Annotated[
        list[str] | None, typer.Option(help="Logger: csv, tensorboard or wandb; repeatable.")
    ] = None,
    devices: Annotated[str, typer.Option(help="Number or list of devices (Lightning).")] = "auto",
    accelerator: options.Accelerator = "auto",
    precision: Annotated[str, typer.Option(help="32-true or bf16-mixed (Lightning).")] = "32-true",
) -> None:
    """Train the stages of a run, one after the other."""
    from sceneprior.apps.config import load_config

    settings = load_config(config, tuple(set_ or ()))  # before imports that take seconds
    folder = run or Path("runs") / Path(config).stem
    from sceneprior.training.fit import fit as run_fit

    chosen = {"devices": devices, "accelerator": accelerator, "precision": precision}
    try:
        run_fit(settings, folder, resume, tuple(logger or ("csv", "tensorboard")), chosen)
    except KeyboardInterrupt:
        saved = folder / "config.yaml"
        said = "Stopped before training began; run the same command again."
        if saved.is_file():
            go_on = f"sceneprior fit --config {saved} --run {folder} --resume"
            said = f"Stopped and saved. Continue with: {go_on}"
        typer.echo(said, err=True)
        raise typer.Exit(130) from None
    typer.echo(f"Trained: {folder}")


def report(
    run: Annotated[Path | None, typer.Option(help="Folder of a run that `fit` made.")] = None,
    scenes: options.Scenes = None,
    shards: Annotated[
        Path | None, typer.Option(help="Shards that --scenes were evaluated on.")
    ] = None,
    scores: Annotated[
        Path | None, typer.Option(help="Scores file (default: scores.json in RUN or SCENES).")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="HTML file (default: report.html in RUN or SCENES).")
    ] = None,
    seed: options.Seed = 0,
) -> None:
    """Write one self-contained HTML page of a run or of scenes: inputs, curves, rooms, scores."""
    from sceneprior.apps.experiments.report import report_folder, report_run

    if run is not None and (scenes, shards) == (None, None):
        target = out or run / "report.html"
        if run.is_dir():
            options.checked_target(target)
        report_run(run, scores, target, seed)
    elif scenes is not None and shards is not None and run is None:
        if seed != 0:
            raise InputError("--seed belongs to --run; scenes are shown as they are.")
        target = options.checked_target(out or scenes / "report.html")
        report_folder(scenes, shards, scores, target)
    else:
        raise InputError(
            "Say what to report on: either --run RUN, or --scenes DIR --shards SHARDS."
        )
    typer.echo(f"Wrote {target}")


@contextmanager
def _stopped_by_ctrl_c() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        typer.echo("Stopped. Run the same command again to continue.", err=True)
        raise typer.Exit(130) from None


def _main(arguments: list[str]) -> int | None:
    """The command line itself, for commands that run others; by name, since it imports this."""
    app = pkgutil.resolve_name("sceneprior.apps.cli.commands:app")
    status: int | None = app(arguments, standalone_mode=False)
    return status


def compare(
    config: Annotated[
        str,
        typer.Option(help="Comparison: your YAML, or a shipped one (compare/single_view.yaml)."),
    ] = "compare/paper.yaml",
    out: Annotated[Path, typer.Option(help="Folder for runs and tables.")] = Path("out/compare"),
    methods: Annotated[str | None, typer.Option(help="Methods, such as lifted,lstm.")] = None,
    rooms: Annotated[str | None, typer.Option(help="Kinds of rooms, such as bedroom.")] = None,
    seeds: Annotated[str | None, typer.Option(help="Seeds, such as 0,1 (default: all).")] = None,
    inception: options.Inception = None,
    accelerator: options.Accelerator = "auto",
) -> None:
    """Train and evaluate methods on the same rooms, and tabulate them; run again to continue."""
    from sceneprior.apps.experiments.compare import compare as run_comparison
    from sceneprior.apps.experiments.compare import part_of
    from sceneprior.apps.experiments.comparison import load_comparison

    comparison = load_comparison(config)
    part = part_of(comparison, out, methods, rooms, seeds)
    with _stopped_by_ctrl_c():
        done = run_comparison(comparison, part, out, _main, inception, accelerator)
    if done.table is not None:
        typer.echo(f"Wrote {done.table}")
    if done.left_out:
        typer.echo(
            "Not in the table, because trained or evaluated with other settings, rooms, seeds or "
            f"weights: {'; '.join(done.left_out)}. Name them in the options to "
            "evaluate them again.",
            err=True,
        )
    if done.failures:
        raise InputError(
            f"{len(done.failures)} runs failed and are not in the table: {'; '.join(done.failures)}"
        )


def demo(
    out: Annotated[Path, typer.Option(help="Folder for everything the demo makes.")] = Path(
        "out/demo"
    ),
    config: Annotated[str, typer.Option(help="Config of the training run.")] = "demo.yaml",
    rooms: Annotated[int, typer.Option(min=20, help="Number of homes to make.")] = 240,
    count: Annotated[int, typer.Option(min=2, help="Number of rooms to generate.")] = 200,
) -> None:
    """Run the whole pipeline on procedural homes: shards, training, new rooms, scores, a page."""
    from sceneprior.apps.experiments.commands import run_demo

    with _stopped_by_ctrl_c():
        run_demo(out, config, rooms, count, _main)
    typer.echo(f"Open {out / 'report.html'}; scores are in {out / 'scores.json'}.")

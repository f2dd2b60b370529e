"""Commands that train a run and show what it learnt: fit and report."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.cli.options import AcceleratorOption, CheckpointOption, RendererOption


def fit(
    config: Annotated[str, typer.Option(help="A YAML file, or a shipped one such as demo.yaml.")],
    run: Annotated[
        Path | None, typer.Option(help="Folder for checkpoints and logs (default: runs/<config>).")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Override: model.width=256. Repeatable.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a stopped run.")] = False,
    logger: Annotated[
        list[str] | None, typer.Option(help="csv, tensorboard, wandb. Repeatable.")
    ] = None,
    devices: Annotated[str, typer.Option(help="How many, or which; Lightning's option.")] = "auto",
    accelerator: AcceleratorOption = "auto",
    precision: Annotated[str, typer.Option(help="32-true, bf16-mixed; Lightning's option.")] = (
        "32-true"
    ),
) -> None:
    """Train a run: the layout stage, then the shape stage; or a baseline (`method`)."""
    from sceneprior.config import load_config

    settings = load_config(config, tuple(set_ or ()))  # before what takes seconds to import
    folder = run or Path("runs") / Path(config).stem
    from sceneprior.experiments.evaluate_samples import SampleEvaluator
    from sceneprior.training.fit import fit as run_fit

    options = {"devices": devices, "accelerator": accelerator, "precision": precision}
    try:
        run_fit(
            settings, folder, resume, tuple(logger or ("csv", "tensorboard")), options,
            SampleEvaluator(settings),
        )  # fmt: skip
    except KeyboardInterrupt:
        saved = folder / "config.yaml"
        said = "Stopped before training began; run the same command again."
        if saved.is_file():
            go_on = f"sceneprior fit --config {saved} --run {folder} --resume"
            said = f"Stopped and saved. Go on with: {go_on}"
        typer.echo(said, err=True)
        raise typer.Exit(130) from None
    typer.echo(f"Trained: {folder}")


def report(
    run: Annotated[Path, typer.Option(help="Folder of a run that `fit` made.")],
    scores: Annotated[Path | None, typer.Option(help="From eval-fid (RUN/scores.json).")] = None,
    out: Annotated[Path | None, typer.Option(help="HTML file (default: RUN/report.html).")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the generated rooms shown.")] = 0,
    command: Annotated[
        list[str] | None, typer.Option(help="A command to list on the page. Repeatable.")
    ] = None,
    checkpoint: CheckpointOption = "final",
    renderer: RendererOption = "auto",
) -> None:
    """Write one self-contained page: inputs, curves, rooms, scores."""
    from sceneprior.experiments.evaluate import report_run

    target = out or run / "report.html"
    report_run(
        run, scores or run / "scores.json", target, seed, tuple(command or ()), renderer, checkpoint
    )
    typer.echo(f"Wrote {target}")

"""The `sceneprior` command. A verb imports what it needs when called, so help is instant."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from data_prep.cli import add_commands
from sceneprior import __version__
from sceneprior.errors import InputError

app = typer.Typer(
    name="sceneprior",
    help="Learn priors of furnished rooms from posed instance masks, and use them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
add_commands(app)

RendererOption = Annotated[
    str, typer.Option(help="auto, pyrender or software (needs no GL library).")
]
RunOption = Annotated[Path, typer.Option(help="Folder of a run that `fit` made.")]
LawOption = Annotated[
    str | None,
    typer.Option(help="kernel, geodesic, gaussian or paper (default: the config's)."),
]
CheckpointOption = Annotated[
    str,
    typer.Option(help="final, or best: what generated best while training (samples.every)."),
]


def _show_version(wanted: bool | None) -> None:
    if wanted:
        typer.echo(f"sceneprior {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool | None,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Say it."),
    ] = None,
) -> None:
    pass


@app.command()
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
    accelerator: Annotated[str, typer.Option(help="cpu, gpu, auto; Lightning's option.")] = "auto",
    precision: Annotated[str, typer.Option(help="32-true, bf16-mixed; Lightning's option.")] = (
        "32-true"
    ),
) -> None:
    """Train a prior: the layout stage, then the shape stage."""
    from sceneprior.config import load_config

    settings = load_config(config, tuple(set_ or ()))
    folder = run or Path("runs") / Path(config).stem
    from sceneprior.stages.train import fit as run_fit
    from sceneprior.tasks.watch import SampleJudge

    options = {"devices": devices, "accelerator": accelerator, "precision": precision}
    try:
        run_fit(
            settings, folder, resume, tuple(logger or ("csv", "tensorboard")), options,
            SampleJudge(settings),
        )  # fmt: skip
    except KeyboardInterrupt:
        typer.echo(
            "Stopped and saved. Go on with: sceneprior fit "
            f"--config {folder / 'config.yaml'} --run {folder} --resume",
            err=True,
        )
        raise typer.Exit(130) from None
    typer.echo(f"Trained: {folder}")


@app.command()
def synthesize(
    run: RunOption,
    out: Annotated[Path, typer.Option(help="Folder for the scenes.")],
    count: Annotated[int, typer.Option("-n", "--count", min=1, help="How many rooms.")] = 16,
    seed: Annotated[int, typer.Option(help="Same seed, same rooms.")] = 0,
    law: LawOption = None,
    checkpoint: CheckpointOption = "final",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")] = False,
    renderer: RendererOption = "auto",
) -> None:
    """Generate rooms: JSON, GLB and a top-down PNG each."""
    from sceneprior.offscreen import open_renderer
    from sceneprior.stages.runs import load_run
    from sceneprior.tasks.decode import synthesize as generate
    from sceneprior.tasks.export import write_scenes

    scenes = generate(load_run(run, checkpoint), count, seed, law)
    write_scenes(scenes, out, open_renderer(renderer), overwrite)
    typer.echo(f"Wrote {count} rooms to {out}")


@app.command("eval-fid")
def eval_fid(
    run: RunOption,
    count: Annotated[int, typer.Option("-n", "--count", min=2, help="Generated rooms.")] = 1000,
    seed: Annotated[int, typer.Option(help="Of the generated rooms.")] = 0,
    inception: Annotated[
        Path | None, typer.Option(help="inception-2015-12-05.pt (TorchScript), for FID proper.")
    ] = None,
    shards: Annotated[
        Path | None, typer.Option(help="Shards to judge against (default: those of the run).")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="JSON file (default: RUN/scores.json).")] = None,
    law: LawOption = None,
    checkpoint: CheckpointOption = "final",
    renderer: RendererOption = "auto",
) -> None:
    """Judge generated rooms against test rooms, with the whole protocol beside the figures."""
    from sceneprior.evaluation.protocol import print_scores
    from sceneprior.tasks.judge import judge_run

    target = out or run / "scores.json"
    print_scores(judge_run(run, count, seed, inception, shards, target, law, renderer, checkpoint))
    typer.echo(f"Wrote {target}")


@app.command()
def report(
    run: RunOption,
    scores: Annotated[Path | None, typer.Option(help="From eval-fid (RUN/scores.json).")] = None,
    out: Annotated[Path | None, typer.Option(help="HTML file (default: RUN/report.html).")] = None,
    seed: Annotated[int, typer.Option(help="Of the generated rooms shown.")] = 0,
    command: Annotated[
        list[str] | None, typer.Option(help="A command to list on the page. Repeatable.")
    ] = None,
    checkpoint: CheckpointOption = "final",
    renderer: RendererOption = "auto",
) -> None:
    """Write one self-contained page: inputs, curves, rooms, scores."""
    from sceneprior.tasks.judge import report_run

    target = out or run / "report.html"
    report_run(
        run, scores or run / "scores.json", target, seed, tuple(command or ()), renderer, checkpoint
    )
    typer.echo(f"Wrote {target}")


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for everything the demo makes.")] = Path(
        "out/demo"
    ),
    config: Annotated[str, typer.Option(help="What to train.")] = "demo.yaml",
    rooms: Annotated[int, typer.Option(min=20, help="Homes to make.")] = 480,
    count: Annotated[int, typer.Option(min=2, help="Rooms to generate and judge.")] = 200,
    renderer: RendererOption = "auto",
) -> None:
    """The whole path on homes made here: homes, shards, fit, new rooms, scores, a page."""
    from sceneprior.tasks.demo import run_demo

    run_demo(out, config, rooms, count, renderer)


def main() -> None:
    """Run the command; whatever is wrong with the input is one sentence and exit status 2."""
    try:
        app()
    except InputError as error:
        typer.echo(f"Error: {error}", err=True)
        sys.exit(2)
    except FloatingPointError as error:
        typer.echo(f"Error: {error}", err=True)
        sys.exit(2)
    except Exception as error:
        if os.environ.get("SCENEPRIOR_DEBUG"):
            raise
        typer.echo(
            f"Error: {type(error).__name__}: {error}\nThis should not happen. Run again with "
            "SCENEPRIOR_DEBUG=1 for the traceback, and please report it.",
            err=True,
        )
        sys.exit(1)

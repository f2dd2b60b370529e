"""Verbs that judge rooms; what a verb needs it imports when called."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.commands.options import CheckpointOption, LawOption, RendererOption, RunOption


def add_commands(app: typer.Typer) -> None:
    """Mount eval-fid."""
    app.command("eval-fid")(eval_fid)


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

"""Verbs that make new rooms from a run; what a verb needs it imports when called."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.commands.options import (
    CheckpointOption,
    LawOption,
    OverwriteOption,
    RendererOption,
    RunOption,
)


def add_commands(app: typer.Typer) -> None:
    """Mount synthesize."""
    app.command()(synthesize)


def synthesize(
    run: RunOption,
    out: Annotated[Path, typer.Option(help="Folder for the scenes.")],
    count: Annotated[int, typer.Option("-n", "--count", min=1, help="How many rooms.")] = 16,
    seed: Annotated[int, typer.Option(help="Same seed, same rooms.")] = 0,
    law: LawOption = None,
    checkpoint: CheckpointOption = "final",
    overwrite: OverwriteOption = False,
    renderer: RendererOption = "auto",
) -> None:
    """Generate rooms: JSON, GLB and a top-down PNG each."""
    from sceneprior.offscreen import open_renderer
    from sceneprior.stages.runs import load_any_run
    from sceneprior.tasks.decode import synthesize as generate
    from sceneprior.tasks.export import write_scenes

    scenes = generate(load_any_run(run, checkpoint), count, seed, law)
    write_scenes(scenes, out, open_renderer(renderer), overwrite)
    typer.echo(f"Wrote {count} rooms to {out}")

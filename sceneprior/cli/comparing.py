"""The verb that sets methods side by side; what it needs it imports when called."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.cli.options import RendererOption


def add_commands(app: typer.Typer) -> None:
    """Mount compare."""
    app.command()(compare)


def compare(
    config: Annotated[
        str, typer.Option(help="A comparison, such as compare_front_small.yaml.")
    ] = "compare_front_small.yaml",
    out: Annotated[Path, typer.Option(help="Folder for runs, tables and figures.")] = Path(
        "out/compare"
    ),
    methods: Annotated[str | None, typer.Option(help="Some of them: ours,lstm.")] = None,
    rooms: Annotated[str | None, typer.Option(help="Some kinds of rooms: bedroom.")] = None,
    seeds: Annotated[str | None, typer.Option(help="Some of the seeds: 0,1.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Runs at a time.")] = 1,
    inception: Annotated[
        Path | None, typer.Option(help="inception-2015-12-05.pt (TorchScript), for FID proper.")
    ] = None,
    accelerator: Annotated[
        str, typer.Option(help="cpu, gpu, auto; Lightning's option. One device a run.")
    ] = "auto",
    renderer: RendererOption = "auto",
) -> None:
    """Train, judge and tabulate methods on the same rooms; run again to go on."""
    from sceneprior.errors import InputError
    from sceneprior.experiments.compare import compare as run_comparison
    from sceneprior.experiments.comparison import load_comparison, part_of

    comparison = load_comparison(config)
    part = part_of(comparison, methods, rooms, seeds)
    try:
        done = run_comparison(comparison, part, out, jobs, renderer, inception, accelerator)
    except KeyboardInterrupt:
        typer.echo("Stopped. The same command goes on from here.", err=True)
        raise typer.Exit(130) from None
    if done.table is not None:
        typer.echo(f"Wrote {done.table}")
    if done.left_out:
        typer.echo(
            "Not in the table, since judged otherwise (rooms, seed, renderer or weights): "
            f"{'; '.join(done.left_out)}. Ask for them as well, and they are judged again.",
            err=True,
        )
    if done.failures:
        raise InputError(
            f"{len(done.failures)} runs failed and are not in the table: {'; '.join(done.failures)}"
        )

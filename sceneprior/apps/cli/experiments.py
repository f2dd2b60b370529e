"""Commands that run many others: compare and demo."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from sceneprior.apps.cli.options import AcceleratorOption, InceptionOption
from sceneprior.core.errors import InputError


@contextmanager
def _stopped_by_ctrl_c() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        typer.echo("Stopped. Run the same command again to continue.", err=True)
        raise typer.Exit(130) from None


def compare(
    config: Annotated[
        str,
        typer.Option(help="Comparison: your YAML, or a shipped one (compare/single_view.yaml)."),
    ] = "compare/paper.yaml",
    out: Annotated[Path, typer.Option(help="Folder for runs and tables.")] = Path("out/compare"),
    methods: Annotated[str | None, typer.Option(help="Methods, such as lifted,lstm.")] = None,
    rooms: Annotated[str | None, typer.Option(help="Kinds of rooms, such as bedroom.")] = None,
    seeds: Annotated[str | None, typer.Option(help="Seeds, such as 0,1 (default: all).")] = None,
    inception: InceptionOption = None,
    accelerator: AcceleratorOption = "auto",
) -> None:
    """Train and evaluate methods on the same rooms, and tabulate them; run again to continue."""
    from sceneprior.apps.experiments.compare import compare as run_comparison
    from sceneprior.apps.experiments.comparison import part_of
    from sceneprior.apps.experiments.runs import load_comparison

    comparison = load_comparison(config)
    part = part_of(comparison, methods, rooms, seeds)
    with _stopped_by_ctrl_c():
        done = run_comparison(comparison, part, out, inception, accelerator)
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
    from sceneprior.apps.experiments.demo import run_demo

    with _stopped_by_ctrl_c():
        run_demo(out, config, rooms, count)
    typer.echo(f"Open {out / 'report.html'}; scores are in {out / 'scores.json'}.")

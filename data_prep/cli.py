"""The commands that prepare data; `sceneprior.cli` mounts them. Heavy imports wait inside."""

from pathlib import Path
from typing import Annotated

import typer

from data_prep.homes.command import make_homes_command


def add_commands(app: typer.Typer) -> None:
    """Mount prep-front, inspect and make-homes."""
    app.command("make-homes")(make_homes_command)
    app.command("prep-front")(prep_front)
    app.command("inspect")(inspect)


def prep_front(
    front: Annotated[Path, typer.Option(help="Folder of house JSONs (3D-FRONT).")],
    future: Annotated[Path, typer.Option(help="Folder of furniture models (3D-FUTURE-model).")],
    out: Annotated[Path, typer.Option(help="Folder for the shards.")],
    room_type: Annotated[str, typer.Option(help="bedroom or living.")] = "bedroom",
    splits: Annotated[
        Path | None, typer.Option(help="CSV of `room id,split`; without it, a seeded 9:1.")
    ] = None,
    val: Annotated[str, typer.Option(help="Where val rooms go: train, test or none.")] = "train",
    views_per_m2: Annotated[
        float | None,
        typer.Option(help="Views per square metre of floor (default: the recipe's: 2)."),
    ] = None,
    rule: Annotated[
        list[str] | None, typer.Option(help="Change a rule of the recipe: max_floor_m=8, or null.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same bytes.")] = 0,
    workers: Annotated[int | None, typer.Option(help="Processes (default: all cores).")] = None,
    renderer: Annotated[str, typer.Option(help="auto, pyrender or software.")] = "auto",
    only: Annotated[
        str | None, typer.Option(help="One house or room: HOUSE, HOUSE/ROOM or a room id.")
    ] = None,
) -> None:
    """Turn houses in 3D-FRONT's format into view shards. Run again to go on after a stop."""
    import os

    from data_prep.build import FrontJob, build_shards
    from data_prep.recipe import load_recipe

    changes = list(rule or [])
    if views_per_m2 is not None:
        changes.append(f"views.per_m2={views_per_m2}")
    job = FrontJob(
        front=front,
        future=future,
        out=out,
        recipe=load_recipe(f"front3d_{room_type}", tuple(changes)),
        splits=splits,
        seed=seed,
        workers=workers or len(os.sched_getaffinity(0)),
        renderer=renderer,
        only=only,
        val=val,
    )
    try:
        summary = build_shards(job)
    except KeyboardInterrupt:
        typer.echo("Stopped; finished shards are kept. Run the same command to go on.", err=True)
        raise typer.Exit(130) from None
    made = f"{summary.shards_made} shards made, {summary.shards_kept} already there"
    typer.echo(f"{out}: {summary} ({made}; {summary.renderer})")


def inspect(
    shards: Annotated[Path, typer.Argument(help="Folder of shards.")],
    png: Annotated[Path | None, typer.Option(help="Also draw a sheet of views here.")] = None,
    room: Annotated[str | None, typer.Option(help="Draw views of this room only.")] = None,
    pictures: Annotated[int, typer.Option(help="Views on the sheet.")] = 24,
    boxes_3d: Annotated[
        bool, typer.Option("--boxes-3d", help="Draw the ground truth's 3D boxes, too.")
    ] = False,
) -> None:
    """Say what a folder of shards holds, and draw some of it."""
    from rich.console import Console
    from rich.table import Table

    from data_prep.inspection import contact_sheet, count_shards

    counts = count_shards(shards)
    totals = Table("split", "rooms", "views", "objects", "objects a room", "objects a view")
    for split, row in counts.items():
        totals.add_row(
            split,
            str(row["rooms"]),
            str(row["views"]),
            str(row["objects"]),
            f"{row['objects'] / max(row['rooms'], 1):.2f}",
            f"{row['seen']:.2f}",
        )
    histogram = Table("class", *counts)
    names = sorted({name for row in counts.values() for name in row["classes"]})
    for name in names:
        histogram.add_row(name, *(str(row["classes"].get(name, 0)) for row in counts.values()))
    console = Console()
    console.print(totals)
    console.print(histogram)
    if png is not None:
        png.parent.mkdir(parents=True, exist_ok=True)
        contact_sheet(shards, room, pictures, boxes_3d).save(png)
        typer.echo(f"Drew {png}.")

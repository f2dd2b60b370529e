"""Commands that prepare data, mounted by `sceneprior.apps.cli`.

Heavy imports stand inside the functions, so that the command line starts quickly.
"""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from data_prep.homes.command import make_homes_command
from data_prep.inspection.command import inspect_command
from sceneprior.core.seeds import LARGEST_SEED

if TYPE_CHECKING:
    from data_prep.engine.source import Source


def add_commands(app: typer.Typer) -> None:
    """Mount the prep-* commands, inspect and make-homes."""
    app.command("make-homes")(make_homes_command)
    app.command("prep-front")(prep_front)
    app.command("recipe")(recipe)
    app.command("prep-scannet")(prep_scannet)
    app.command("prep-posed")(prep_posed)
    app.command("inspect")(inspect_command)


OutOption = Annotated[Path, typer.Option(help="Folder for the shards.")]
WorkersOption = Annotated[
    int | None, typer.Option(min=1, help="Processes on this machine (default: all cores).")
]
SchedulerOption = Annotated[
    str | None, typer.Option(help="Work on a Dask cluster instead: tcp://HOST:8786.")
]
OnlyOption = Annotated[
    str | None, typer.Option(help="One house or room: HOUSE, HOUSE/ROOM or a room id.")
]
StrictOption = Annotated[bool, typer.Option("--strict", help="Stop at the first failed room.")]
RetryOption = Annotated[
    bool, typer.Option("--retry-failed", help="Try rooms again that failed in an earlier run.")
]


def prep_front(
    front: Annotated[Path, typer.Option(help="Folder of house JSONs (3D-FRONT).")],
    future: Annotated[Path, typer.Option(help="Folder of furniture models (3D-FUTURE-model).")],
    out: OutOption,
    recipe: Annotated[
        str,
        typer.Option(
            help="Which rooms and classes: bedroom, living, dining, library, kitchen, all, "
            "atiss_bedroom, atiss_living, atiss_dining, or a file such as mine.yaml."
        ),
    ] = "bedroom",
    splits: Annotated[
        Path | None, typer.Option(help="CSV of `room id,split`; without it, a seeded 8:1:1.")
    ] = None,
    views_per_m2: Annotated[
        float | None,
        typer.Option(help="Views per square metre of floor (default: the recipe's: 2)."),
    ] = None,
    rule: Annotated[
        list[str] | None, typer.Option(help="Change a rule of the recipe: max_floor_m=8, or null.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Same seed, same bytes.")] = 0,
    rgb: Annotated[
        bool, typer.Option("--rgb", help="Also draw shaded pictures: OUT/rgb/ROOM/VIEW.png.")
    ] = False,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    renderer: Annotated[str, typer.Option(help="auto, pyrender or software.")] = "auto",
    only: OnlyOption = None,
    strict: StrictOption = False,
    retry_failed: RetryOption = False,
) -> None:
    """Turn houses in 3D-FRONT's format into view shards. Run again to go on after a stop.

    Exit status: 0, or 3 if rooms failed (the others are prepared; report.csv says why).
    """
    from data_prep.front.recipe import load_recipe
    from data_prep.front.source import FrontSource

    changes = list(rule or [])
    if views_per_m2 is not None:
        changes.append(f"views.per_m2={views_per_m2}")
    rules = load_recipe(recipe, tuple(changes))
    source = FrontSource(front, future, rules, splits, seed, only, rgb)
    run_job(source, out, workers, scheduler, renderer, strict, retry_failed)


def recipe(
    name: Annotated[str, typer.Argument(help="bedroom, living, dining, library, kitchen, all.")],
) -> None:
    """Print a recipe of prep-front, to start one of your own: recipe bedroom > mine.yaml."""
    from data_prep.front.recipe import recipe_text

    typer.echo(recipe_text(name), nl=False)


def prep_scannet(
    scans: Annotated[Path, typer.Option(help="ScanNet's folder of scans.")],
    labels: Annotated[Path, typer.Option(help="scannetv2-labels.combined.tsv.")],
    out: OutOption,
    masks: Annotated[
        str, typer.Option(help="filt (cleaned) or raw (the projected mesh).")
    ] = "filt",
    full_size: Annotated[
        bool, typer.Option("--full-size", help="1296 x 968 rather than a quarter of it.")
    ] = False,
    frame_step: Annotated[int, typer.Option(help="Every so many frames is a candidate.")] = 15,
    max_views: Annotated[int, typer.Option(help="Candidates are thinned to this many.")] = 100,
    train_list: Annotated[Path | None, typer.Option(help="scannetv2_train.txt.")] = None,
    val_list: Annotated[
        Path | None,
        typer.Option(help="scannetv2_val.txt: the test split. Without lists, a seeded 9:1."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Of the 9:1.")] = 0,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    only: Annotated[str | None, typer.Option(help="One scan, or the beginning of names.")] = None,
    strict: StrictOption = False,
    retry_failed: RetryOption = False,
) -> None:
    """Turn ScanNet's recordings into view shards, straight from .sens and the zips.

    Exit status: 0, or 3 if scans failed (the others are prepared; report.csv says why).
    """
    from data_prep.scannet.scans import FULL_SIZE, QUARTER_SIZE, ScanSettings
    from data_prep.scannet.source import ScanNetSource

    size = FULL_SIZE if full_size else QUARTER_SIZE
    settings = ScanSettings(frame_step, max_views, masks, size)
    source = ScanNetSource(scans, labels, settings, train_list, val_list, seed, only)
    run_job(source, out, workers, scheduler, "auto", strict, retry_failed)


def prep_posed(
    rooms: Annotated[
        Path,
        typer.Argument(
            help="A room's folder (transforms.json, or COLMAP's sparse/0), or a folder of such."
        ),
    ],
    out: OutOption,
    label_set: Annotated[
        str,
        typer.Option(help="A file with a class a line, void,bed,chair or a known set's name."),
    ],
    up: Annotated[
        str,
        typer.Option(
            help="The poses' axis that points up: z or y; cameras: as upright cameras were held; "
            "auto: z, or cameras for COLMAP's models."
        ),
    ] = "auto",
    floor_m: Annotated[
        float | None, typer.Option(help="Height of the floor where a file gives no floor_m.")
    ] = None,
    camera_height_m: Annotated[
        float, typer.Option(help="Of the lowest camera, where nothing shows the floor.")
    ] = 1.2,
    metres_per_unit: Annotated[
        float, typer.Option(help="Of the poses, where a file does not say.")
    ] = 1.0,
    max_side: Annotated[
        int | None, typer.Option(help="Sample larger masks down to this (default: as they are).")
    ] = None,
    max_views: Annotated[int, typer.Option(help="Frames are thinned to this many.")] = 100,
    test_share: Annotated[float, typer.Option(help="Share of rooms in the test split.")] = 0.1,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Of the split.")] = 0,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    only: Annotated[str | None, typer.Option(help="One room, or the beginning of names.")] = None,
    strict: StrictOption = False,
) -> None:
    """Turn posed pictures with tracked instance masks into view shards (docs/posed_data.md).

    Exit status: 0, or 3 if rooms failed (the others are prepared; report.csv says why).
    """
    from data_prep.posed.labels import read_label_set
    from data_prep.posed.source import PosedSource
    from data_prep.posed.views import PosedSettings

    settings = PosedSettings(up, floor_m, camera_height_m, metres_per_unit, max_side, max_views)
    classes = read_label_set(label_set)
    source = PosedSource(rooms, classes, settings, test_share, seed, only)
    for sentence in source.assumptions():
        typer.echo(f"Note: {sentence}", err=True)
    run_job(source, out, workers, scheduler, "auto", strict, retry_failed=False)


def run_job(
    source: "Source",
    out: Path,
    workers: int | None,
    scheduler: str | None,
    renderer: str,
    strict: bool,
    retry_failed: bool,
) -> None:
    """Build shards from a source and print the report, for every `prep-*` command.

    Raises:
        InputError: see `build_shards`; `main` prints it and exits with status 2.
        typer.Exit: 3 if rooms failed, 130 after Ctrl-C.
    """
    from rich.console import Console

    from data_prep.engine.build import Job, build_shards
    from data_prep.engine.report_tables import report_tables
    from data_prep.engine.shard_job import RoomFailedError

    workers = workers or len(os.sched_getaffinity(0))
    try:
        summary = build_shards(Job(source, out, workers, scheduler, renderer, strict, retry_failed))
    except KeyboardInterrupt:
        typer.echo("Stopped; finished shards are kept. Run the same command to go on.", err=True)
        raise typer.Exit(130) from None
    except RoomFailedError as error:
        typer.echo(f"Error: {error}", err=True)
        raise typer.Exit(3) from None
    console = Console()
    for table in report_tables(summary.report):
        console.print(table)
    made = f"{summary.shards_made} shards made, {summary.shards_kept} already there"
    if summary.shards_open:
        made += f", {summary.shards_open} still to make: run without --only"
    drawn = f"; {summary.renderer}" if summary.renderer else ""
    typer.echo(f"{out}: {summary} ({made}{drawn})")
    if source.only is None and not summary.counts["test"]["rooms"]:
        typer.echo(
            "Note: the 'test' split is empty. `fit` and `synthesize` need none; eval-fid compares "
            "with test rooms: prepare more rooms, or name some in a file of splits.",
            err=True,
        )
    if summary.statuses.get("failed"):
        raise typer.Exit(3)

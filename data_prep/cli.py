"""Commands that prepare data, mounted by `sceneprior.apps.cli`.

Heavy imports are inside the functions, so that the command line starts quickly.
"""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sceneprior.core.repeatable import LARGEST_SEED

if TYPE_CHECKING:
    from rich.table import Table

    from data_prep.engine.source import Source


def add_commands(app: typer.Typer, with_workers: Callable[..., Any]) -> None:
    """Mount the prep-* commands, inspect and make-homes; `with_workers` adds the options that
    choose where work runs."""
    prep = partial(with_workers, usual=None)
    for command in (
        make_homes, prep(prep_front), recipe, prep(prep_scannet), prep(prep_posed),
        prep(prep_dataset), with_workers(inspect),
    ):  # fmt: skip
        app.command()(command)


_SHEET = "inspect.png"
_PROBLEMS_SHOWN = 10

Out = Annotated[Path, typer.Option(help="Folder for the shards.")]
Seed = Annotated[
    int, typer.Option(min=0, max=LARGEST_SEED, help="The same seed writes the same bytes.")
]
Retry = Annotated[
    bool, typer.Option("--retry-failed", help="Try rooms again that failed in an earlier run.")
]
MaxViews = Annotated[
    int, typer.Option(help="Largest number of views per room; others are thinned out.")
]


def make_homes(
    out: Annotated[Path, typer.Argument(help="A new folder for the homes.")],
    rooms: Annotated[
        int, typer.Option(help="Number of rooms: 70% train, 10% val, 20% test.")
    ] = 400,
    room_type: Annotated[str, typer.Option(help="bedroom or living.")] = "bedroom",
    seed: Seed = 0,
) -> None:
    """Make furnished homes in 3D-FRONT's on-disk format."""
    from data_prep.homes import make

    make.make_homes(out, rooms, room_type, seed)
    typer.echo(f"Wrote {rooms} {room_type} rooms to {out}")


def prep_front(
    front: Annotated[Path, typer.Option(help="Folder of house JSONs (3D-FRONT).")],
    future: Annotated[Path, typer.Option(help="Folder of furniture models (3D-FUTURE-model).")],
    out: Out,
    recipe: Annotated[
        str,
        typer.Option(
            help="Which rooms and classes: bedroom, living, dining, library, kitchen, all, "
            "atiss_bedroom, atiss_living, atiss_dining, or a file such as mine.yaml."
        ),
    ] = "bedroom",
    splits: Annotated[
        Path | None,
        typer.Option(help="CSV with rows `room id,split` (default: a random 8:1:1 split)."),
    ] = None,
    views_per_m2: Annotated[
        float | None,
        typer.Option(help="Views per square metre of floor (default: the recipe's: 2)."),
    ] = None,
    rule: Annotated[
        list[str] | None,
        typer.Option(help="Change a rule of the recipe: max_floor_m=8; null turns it off."),
    ] = None,
    seed: Seed = 0,
    renderer: Annotated[str, typer.Option(help="auto, pyrender or software.")] = "auto",
    only: Annotated[
        str | None, typer.Option(help="One house or room only: HOUSE, HOUSE/ROOM or a room id.")
    ] = None,
    retry_failed: Retry = False,
) -> None:
    """Turn houses in 3D-FRONT's format into view shards. The same command resumes a stopped run.

    Exit status: 0, or 3 if rooms failed (the others are prepared; report.csv says why).
    """
    from data_prep.front.recipe import load_recipe
    from data_prep.front.source import FrontSource

    density = () if views_per_m2 is None else (f"views.per_m2={views_per_m2}",)
    rules = load_recipe(recipe, (*(rule or ()), *density))
    source = FrontSource(front, future, rules, splits, seed, only)
    run_job(source, out, retry_failed=retry_failed, renderer=renderer)


def recipe(
    name: Annotated[str, typer.Argument(help="bedroom, living, dining, library, kitchen, all.")],
) -> None:
    """Print a recipe of prep-front, as a template for your own: recipe bedroom > mine.yaml."""
    from data_prep.front.recipe import recipe_text

    typer.echo(recipe_text(name), nl=False)


def prep_scannet(
    scans: Annotated[Path, typer.Option(help="ScanNet's folder of scans.")],
    labels: Annotated[Path, typer.Option(help="scannetv2-labels.combined.tsv.")],
    out: Out,
    masks: Annotated[
        str, typer.Option(help="ScanNet's masks: filt (cleaned) or raw (the mesh, projected).")
    ] = "filt",
    full_size: Annotated[
        bool, typer.Option("--full-size", help="Images of 1296 x 968 pixels, not 324 x 242.")
    ] = False,
    frame_step: Annotated[int, typer.Option(help="Every n-th frame is a candidate.")] = 15,
    max_views: MaxViews = 100,
    train_list: Annotated[
        Path | None, typer.Option(help="List of training scans, scannetv2_train.txt.")
    ] = None,
    val_list: Annotated[
        Path | None,
        typer.Option(help="List of test scans, scannetv2_val.txt (default: a random 9:1 split)."),
    ] = None,
    seed: Seed = 0,
    only: Annotated[str | None, typer.Option(help="A scan, or a prefix of scans' names.")] = None,
    retry_failed: Retry = False,
) -> None:
    """Turn ScanNet's recordings into view shards, directly from .sens files and zips.

    Exit status: 0, or 3 if scans failed (the others are prepared; report.csv says why).
    """
    from data_prep.readers.scannet import FULL_SIZE, QUARTER_SIZE, ScanNet

    source = ScanNet(
        scans, labels=labels, frame_step=frame_step, max_views=max_views, masks=masks,
        image_size=FULL_SIZE if full_size else QUARTER_SIZE, train=train_list, val=val_list,
        seed=seed, only=only,
    )  # fmt: skip
    run_job(source, out, retry_failed=retry_failed)


def prep_posed(
    rooms: Annotated[
        Path, typer.Argument(help="A room's folder (its poses and masks), or a folder of such.")
    ],
    out: Out,
    label_set: Annotated[
        str,
        typer.Option(
            help="Classes: a file with one per line, a list (void,bed,chair), or a set's name."
        ),
    ],
    class_map: Annotated[
        Path | None,
        typer.Option(help="CSV of names of the masks and their classes: rows `bed chair,chair`."),
    ] = None,
    tools: Annotated[
        list[str] | None,
        typer.Option(
            "--from",
            help="The tool that wrote the poses: nerfstudio, colmap, polycam, record3d; give it "
            "again for the masks: png, panoptic, sam2, grounded-sam2, coco (default: guessed).",
        ),
    ] = None,
    model: Annotated[int | None, typer.Option(help="COLMAP model (default: the largest).")] = None,
    up: Annotated[
        str,
        typer.Option(
            help="Axis of the poses that points up: z or y. `cameras` finds it from upright "
            "cameras; `auto` is z, y for Polycam, `cameras` for COLMAP and Record3D."
        ),
    ] = "auto",
    tracks: Annotated[
        str,
        typer.Option(
            help="given: an object has the same id in all frames. auto: ids mean nothing across "
            "frames, and objects are found from poses, masks and classes."
        ),
    ] = "given",
    floor_m: Annotated[
        float | None, typer.Option(help="Height of the floor in rooms whose file has no floor_m.")
    ] = None,
    camera_height_m: Annotated[
        float, typer.Option(help="Height of the lowest camera, where no furniture shows the floor.")
    ] = 1.2,
    metres_per_unit: Annotated[
        float, typer.Option(help="Metres per unit of the poses, in rooms whose file has none.")
    ] = 1.0,
    max_side: Annotated[
        int | None,
        typer.Option(help="Longest side of stored masks in pixels (default: as they are)."),
    ] = None,
    max_views: MaxViews = 100,
    test_share: Annotated[float, typer.Option(help="Share of rooms in the test split.")] = 0.1,
    seed: Seed = 0,
    only: Annotated[str | None, typer.Option(help="A room, or a prefix of rooms' names.")] = None,
) -> None:
    """Turn posed pictures with instance masks into view shards (docs/posed_data.md).

    Exit status: 0, or 3 if rooms failed (the others are prepared; report.csv says why).
    """
    from data_prep.readers.posed.formats import read_class_map, read_formats, read_label_set
    from data_prep.readers.posed.reader import Posed

    classes = read_label_set(label_set)
    source = Posed(
        rooms, classes=classes, class_map=read_class_map(class_map, classes),
        **read_formats(tools or ()), up=up,
        floor_m=floor_m, camera_height_m=camera_height_m, metres_per_unit=metres_per_unit,
        max_side=max_side, tracks=tracks, max_views=max_views, test_share=test_share, seed=seed,
        only=only, model=model,
    )  # fmt: skip
    for sentence in source.found():
        typer.echo(f"Found {sentence}", err=True)
    for sentence in source.assumptions():
        typer.echo(f"Note: {sentence}", err=True)
    run_job(source, out, verified=True)


def prep_dataset(
    name: Annotated[str, typer.Argument(help="blenderproc, hypersim, structured3d or scannetpp.")],
    folder: Annotated[Path, typer.Argument(help="Folder of its scenes (docs/public_data.md).")],
    out: Out,
    recipe: Annotated[
        str | None,
        typer.Option(
            help="For blenderproc: a recipe of prep-front, its room types and classes "
            "(default: bedroom)."
        ),
    ] = None,
    splits: Annotated[
        Path | None,
        typer.Option(
            help="CSV with rows `room or scene,split` (default: the data set's own for "
            "structured3d, else a random 9:1 split of scenes)."
        ),
    ] = None,
    max_side: Annotated[int, typer.Option(help="Longest side of stored masks in pixels.")] = 480,
    max_views: MaxViews = 100,
    seed: Seed = 0,
    only: Annotated[
        str | None, typer.Option(help="One scene or room only: SCENE, SCENE/ROOM or a room id.")
    ] = None,
    retry_failed: Retry = False,
) -> None:
    """Turn a public data set into view shards (docs/public_data.md).

    Exit status: 0, or 3 if rooms failed (the others are prepared; report.csv says why).
    """
    from data_prep.readers import open_reader

    source = open_reader(
        name, folder, recipe, splits=splits, max_side=max_side, max_views=max_views, seed=seed,
        only=only,
    )  # fmt: skip
    run_job(source, out, retry_failed=retry_failed)


def inspect(
    shards: Annotated[Path, typer.Argument(help="Folder of shards.")],
    room: Annotated[str | None, typer.Option(help="This room only, with its floor plan.")] = None,
    png: Annotated[
        Path | None, typer.Option(help=f"File for the pictures (default: SHARDS/{_SHEET}).")
    ] = None,
    pictures: Annotated[int, typer.Option(min=1, help="Number of views to draw.")] = 24,
    verify: Annotated[
        bool, typer.Option("--verify", help="Check everything instead of drawing.")
    ] = False,
) -> None:
    """Print what a folder of shards holds and draw some views, or check it with --verify.

    Exit status: 0, or 3 if --verify finds something wrong.
    """
    from data_prep.inspection.pictures import draw_sheet
    from data_prep.inspection.tables import count_tables, room_table
    from sceneprior.core.files import write_whole
    from sceneprior.render.appearance import png_bytes

    if verify:
        _verify(shards, room)
    else:
        _print(count_tables(shards) if room is None else [room_table(shards, room)])
    if png is not None or not verify:
        target = png or shards / _SHEET
        write_whole(target, png_bytes(draw_sheet(shards, room, pictures)))
        typer.echo(f"Drew {target}.")


def _print(tables: "Iterable[Table]") -> None:
    from rich.console import Console

    for table in tables:
        Console().print(table)


def _verify(shards: Path, room: str | None) -> None:
    from data_prep.inspection.tables import check_tables, summary
    from data_prep.inspection.verify import verify

    found = verify(shards, room)
    _print(check_tables(found))
    for sentence in found.problems[1:_PROBLEMS_SHOWN]:
        typer.echo(sentence, err=True)
    if found.problems:
        more = len(found.problems) - 1
        others = f" ({more} more problem{'s' * (more > 1)}, listed above)" if more else ""
        typer.echo(f"Error: {found.problems[0]}{others}", err=True)
        raise typer.Exit(3)
    typer.echo(f"{shards}: {summary(found)}")


def run_job(source: "Source", out: Path, verified: bool = False, **options: Any) -> None:
    """Build shards and print the report, for every `prep-*` command; `options` are those of
    `Job`. If `verified`, the verdict of `inspect --verify` follows."""
    from data_prep.engine.build import Job, build_shards
    from data_prep.engine.report import report_tables

    try:
        summary = build_shards(Job(source, out, **options))
    except KeyboardInterrupt:
        typer.echo("Stopped; finished shards are kept. Run the same command to continue.", err=True)
        raise typer.Exit(130) from None
    _print(report_tables(summary.report))
    made = f"{summary.shards_made} shards made, {summary.shards_kept} already there"
    if summary.shards_open:
        made += f", {summary.shards_open} still to make: run without --only"
    drawn = f"; {summary.renderer}" if summary.renderer else ""
    typer.echo(f"{out}: {summary} ({made}{drawn})")
    if verified and not summary.shards_open and summary.statuses.get("prepared"):
        from data_prep.inspection.tables import verdict
        from data_prep.inspection.verify import verify

        typer.echo(f"Note: {verdict(verify(out))}", err=True)
    if source.only is None and not summary.counts["test"]["rooms"]:
        typer.echo(
            "Note: the 'test' split is empty. `fit` and `synthesize` do not need it, but eval-fid "
            "does: prepare more rooms, or assign some to `test` in a file of splits.",
            err=True,
        )
    if summary.statuses.get("failed"):
        raise typer.Exit(3)

"""`sceneprior inspect`: the command around contents.py and verify.py."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from data_prep.inspection.agreement import Agreement
    from data_prep.inspection.verify import FolderCheck

SHEET_NAME = "inspect.png"
_WORST_SHOWN = 5
_PROBLEMS_SHOWN = 10


def inspect_command(
    shards: Annotated[Path, typer.Argument(help="Folder of shards.")],
    room: Annotated[str | None, typer.Option(help="This room only, and its plan.")] = None,
    png: Annotated[
        Path | None, typer.Option(help=f"The sheet of pictures (default: SHARDS/{SHEET_NAME}).")
    ] = None,
    pictures: Annotated[int, typer.Option(min=1, help="Views on the sheet.")] = 24,
    boxes_3d: Annotated[
        bool, typer.Option("--boxes-3d/--no-boxes-3d", help="Draw the ground truth's 3D boxes.")
    ] = True,
    verify: Annotated[
        bool, typer.Option("--verify", help="Check everything instead of drawing.")
    ] = False,
    workers: Annotated[int, typer.Option(min=1, help="Processes for --verify.")] = 1,
) -> None:
    """Say what a folder of shards holds and draw a sheet of it, or check it with --verify.

    Exit status: 0, or 3 if --verify finds something wrong.
    """
    from rich.console import Console

    from data_prep.inspection.contents import draw_sheet
    from sceneprior.core.errors import InputError
    from sceneprior.core.files import write_whole
    from sceneprior.render.pictures import png_bytes

    console = Console()
    if verify:
        _verify(console, shards, room, workers)
    else:
        for table in _count_tables(shards) if room is None else [_room_table(shards, room)]:
            console.print(table)
    if png is not None or not verify:
        target = png or shards / SHEET_NAME
        sheet = draw_sheet(shards, room, pictures, boxes_3d)
        try:
            write_whole(target, png_bytes(sheet))
        except OSError as error:
            raise InputError(
                f"{target} cannot be written ({error.strerror or error}); name another file with "
                "--png."
            ) from None
        typer.echo(f"Drew {target}.")


def _count_tables(shards: Path) -> "list[Table]":
    from rich.table import Table

    from data_prep.inspection.contents import count_shards

    counts = count_shards(shards)
    totals = Table(
        "split", "rooms", "views", "objects", "objects a room", "objects a view", "known in 3D",
        "image size",
    )  # fmt: skip
    for split, row in counts.items():
        sizes = row["image_sizes"]
        totals.add_row(
            split,
            str(row["rooms"]),
            str(row["views"]),
            str(row["objects"]),
            f"{row['objects'] / max(row['rooms'], 1):.2f}",
            f"{row['seen']:.2f}",
            f"{row['with_truth']} rooms" if row["with_truth"] else "no room",
            ", ".join(f"{n} rooms: {s}" for s, n in sizes.items())
            if len(sizes) > 1
            else next(iter(sizes), ""),
        )
    histogram = Table("class", *counts)
    for name in sorted({name for row in counts.values() for name in row["classes"]}):
        histogram.add_row(name, *(str(row["classes"].get(name, 0)) for row in counts.values()))
    return [totals, histogram]


def _room_table(shards: Path, room: str) -> "Table":
    from rich.table import Table

    from data_prep.inspection.contents import describe_room

    table = Table("object", "class", "views", "share of image", "centre, m", "size, m", title=room)
    for k, row in enumerate(describe_room(shards, room)):
        place = [
            "unknown" if row[key] is None else " ".join(f"{value:.2f}" for value in row[key])
            for key in ("center_m", "size_m")
        ]
        share = f"{row['share']:.1%}" if row["views"] else "-"
        table.add_row(str(k), row["class"], str(row["views"]), share, *place)
    return table


def _verify(console: "object", shards: Path, room: str | None, workers: int) -> None:
    from data_prep.inspection.verify import verify

    found = verify(shards, room, workers)
    for table in _check_tables(found):
        console.print(table)  # type: ignore[attr-defined]
    for sentence in found.problems[1:_PROBLEMS_SHOWN]:
        typer.echo(sentence, err=True)
    if found.problems:
        more = len(found.problems) - 1
        others = f" ({more} more problem{'s' * (more > 1)}, listed above)" if more else ""
        typer.echo(f"Error: {found.problems[0]}{others}", err=True)
        raise typer.Exit(3)
    typer.echo(f"{shards}: all is well. {_summary(found)}")


def _check_tables(found: "FolderCheck") -> "list[Table]":
    from rich.table import Column, Table

    from data_prep.inspection.agreement import Agreement

    judged = ("in 3D", "masks within", "mean 2D IoU")
    totals = Table("split", "rooms", "views", "checksums", *judged)
    for split, checks in found.rooms.items():
        rooms = [check for check in checks if check.room_id]
        totals.add_row(
            split,
            str(len(rooms)),
            str(sum(check.views for check in rooms)),
            f"{sum(check.has_checksum for check in rooms)} rooms",
            *_judged(sum((check.agreement for check in rooms), Agreement())),
        )
    every = [check for checks in found.rooms.values() for check in checks]
    worst = sorted(
        (check for check in every if check.agreement.tallies),
        key=lambda check: (
            min(tally.share for tally in check.agreement.tallies.values()),
            check.room_id,
        ),
    )
    # Folded, because the end of an id, its room's name, must survive narrow terminals.
    table = Table(Column("worst rooms", overflow="fold"), *judged)
    for check in worst[:_WORST_SHOWN]:
        table.add_row(check.room_id, *_judged(check.agreement))
    return [totals, table] if worst else [totals]


def _judged(agreement: "Agreement") -> tuple[str, str, str]:
    """Table cells: 3D representation, share of masks within projections, IoU if fully visible."""
    from data_prep.inspection.bodies import KINDS

    tallies = agreement.tallies
    return (
        "\n".join(KINDS[kind] for kind in tallies) or "-",
        "\n".join(f"{tally.share:.1%} of {tally.masks}" for tally in tallies.values()) or "-",
        "\n".join(
            f"{tally.mean_iou:.3f} of {tally.whole}" if tally.whole else "-"
            for tally in tallies.values()
        )
        or "-",
    )


def _summary(found: "FolderCheck") -> str:
    from data_prep.inspection.bodies import KINDS

    rooms = [check for checks in found.rooms.values() for check in checks]
    without = sum(not check.has_checksum for check in rooms)
    parts = ["Checksums, shapes, ranges, 2D boxes and masks agree"]
    if without:
        parts.append(f"{without} rooms carry no checksum (shards of an earlier release)")
    for kind, tally in found.agreement.tallies.items():
        text = f"{tally.share:.1%} of {tally.masks} masks lie within their projected {KINDS[kind]}"
        if tally.whole:
            text += f"; {tally.whole} unoccluded ones have a mean 2D IoU of {tally.mean_iou:.3f}"
        parts.append(text)
    if not found.agreement.tallies:
        parts.append("no object could be held against its masks in 3D")
    elif "found" in found.agreement.tallies:
        parts.append("found boxes do not tell whether all is too large, too small or mirrored")
    return "; ".join(parts) + "."

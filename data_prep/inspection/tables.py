"""The tables and sentences that `sceneprior inspect` prints."""

from pathlib import Path

from rich.table import Column, Table

from data_prep.engine.report_tables import make_table
from data_prep.inspection.agreement import Agreement
from data_prep.inspection.bodies import KINDS
from data_prep.inspection.contents import count_shards, describe_room
from data_prep.inspection.verify import FolderCheck

_WORST_SHOWN = 5
_JUDGED = ("in 3D", "masks within", "mean 2D IoU")


def count_tables(shards: Path) -> list[Table]:
    """Counts of each split, and its objects of each class."""
    counts = count_shards(shards)
    totals = []
    for split, row in counts.items():
        sizes = row["image_sizes"]
        several = ", ".join(f"{rooms} rooms: {size}" for size, rooms in sizes.items())
        image_size = next(iter(sizes)) if len(sizes) == 1 else several
        known = f"{row['with_truth']} rooms" if row["with_truth"] else "no room"
        means = f"{row['objects'] / max(row['rooms'], 1):.2f}", f"{row['seen']:.2f}"
        whole = row["rooms"], row["views"], row["objects"]
        totals.append((split, *whole, *means, known, image_size))
    columns = (
        "split", "rooms", "views", "objects", "objects a room", "objects a view", "known in 3D",
        "image size",
    )  # fmt: skip
    names = sorted({name for row in counts.values() for name in row["classes"]})
    classes = [(name, *(row["classes"].get(name, 0) for row in counts.values())) for name in names]
    return [make_table(columns, totals), make_table(("class", *counts), classes)]


def room_table(shards: Path, room: str) -> Table:
    """The objects of one room."""
    table = Table("object", "class", "views", "share of image", "centre, m", "size, m", title=room)
    for k, row in enumerate(describe_room(shards, room)):
        place = [
            "unknown" if row[key] is None else " ".join(f"{value:.2f}" for value in row[key])
            for key in ("center_m", "size_m")
        ]
        share = f"{row['share']:.1%}" if row["views"] else "-"
        table.add_row(str(k), row["class"], str(row["views"]), share, *place)
    return table


def check_tables(found: FolderCheck) -> list[Table]:
    """Results of a check: each split, and the rooms that agree least."""
    totals = []
    for split, checks in found.rooms.items():
        rooms = [check for check in checks if check.room_id]
        views, sums = sum(room.views for room in rooms), sum(room.has_checksum for room in rooms)
        agreement = sum((check.agreement for check in rooms), Agreement())
        totals.append((split, len(rooms), views, f"{sums} rooms", *_judged(agreement)))
    agreements = [(check.room_id, check.agreement) for check in found.every]
    worst = sorted(
        (min(tally.share for tally in agreement.tallies.values()), room_id, _judged(agreement))
        for room_id, agreement in agreements
        if agreement.tallies
    )
    tables = [make_table(("split", "rooms", "views", "checksums", *_JUDGED), totals)]
    if worst:
        # Folded, because the end of an id, its room's name, must survive narrow terminals.
        columns = (Column("worst rooms", overflow="fold"), *_JUDGED)
        rows = [(room_id, *cells) for _, room_id, cells in worst[:_WORST_SHOWN]]
        tables.append(make_table(columns, rows))
    return tables


def _judged(agreement: Agreement) -> list[str]:
    """Table cells: 3D representation, share of masks within projections, IoU if fully visible."""
    cells = [
        (
            KINDS[kind],
            f"{tally.share:.1%} of {tally.masks}",
            f"{tally.mean_iou:.3f} of {tally.whole}" if tally.whole else "-",
        )
        for kind, tally in agreement.tallies.items()
    ]
    return ["\n".join(lines) for lines in zip(*cells, strict=True)] or ["-"] * 3


def summary(found: FolderCheck) -> str:
    """Say how well a folder without problems agrees."""
    without = sum(not check.has_checksum for check in found.every)
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

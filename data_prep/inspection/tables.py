"""The tables and sentences that `sceneprior inspect` prints."""

from collections import Counter
from pathlib import Path

from rich.table import Column, Table

from data_prep.engine.report_tables import make_table
from data_prep.engine.source import SPLITS
from data_prep.inspection.agreement import Agreement
from data_prep.inspection.bodies import KINDS
from data_prep.inspection.pictures import choose_views
from data_prep.inspection.verify import FolderCheck
from sceneprior.core.classes import label_set
from sceneprior.core.shards import Shard, iterate_rooms, read_index

_WORST_SHOWN = 5
_JUDGED = ("in 3D", "masks within", "mean 2D IoU")


def count_tables(folder: Path) -> list[Table]:
    """Counts of each split, and its objects of each class."""
    names = label_set(read_index(folder)["label_set"])
    totals, classes = [], {}
    for split in SPLITS:
        if not any((folder / split).glob("*.h5")):
            continue  # the folder was made with --only
        rooms, known = [], 0
        for shard, room_id in iterate_rooms(folder, split):
            rooms.append(shard.read_room(room_id))
            known += shard.has_ground_truth(room_id)
        views, objects = (sum(room.visible.shape[axis] for room in rooms) for axis in (0, 1))
        seen = sum(int(room.visible.sum()) for room in rooms)
        sizes = Counter("{1} x {0}".format(*room.image_size) for room in rooms).most_common()
        several = ", ".join(f"{count} rooms: {size}" for size, count in sizes)
        means = f"{objects / max(len(rooms), 1):.2f}", f"{seen / max(views, 1):.2f}"
        in_3d = f"{known} rooms" if known else "no room"
        image_size = sizes[0][0] if len(sizes) == 1 else several
        totals.append((split, len(rooms), views, objects, *means, in_3d, image_size))
        classes[split] = Counter(names[index] for room in rooms for index in room.object_class)
    columns = (
        "split", "rooms", "views", "objects", "objects per room", "objects per view", "known in 3D",
        "image size",
    )  # fmt: skip
    every = sorted({name for counts in classes.values() for name in counts})
    rows = [(name, *(counts[name] for counts in classes.values())) for name in every]
    return [make_table(columns, totals), make_table(("class", *classes), rows)]


def room_table(folder: Path, room_id: str) -> Table:
    """The objects of one room; share is the mean area of an object's 2D boxes."""
    ((path, _, _),) = choose_views(folder, room_id, 1)
    with Shard(path) as shard:
        views = shard.read_room(room_id)
        truth = shard.read_ground_truth(room_id) if shard.has_ground_truth(room_id) else None
        names = label_set(shard.label_set)
    rows = []
    for k, index in enumerate((views if truth is None else truth).object_class):
        tracked = k < len(views.object_class)
        boxes = views.boxes[views.visible[:, k], k] if tracked else views.boxes[:0, 0]
        share = f"{(boxes[:, 2:] - boxes[:, :2]).prod(axis=1).mean():.1%}" if len(boxes) else "-"
        place = ["unknown"] * 2
        if truth is not None:
            place = [" ".join(f"{m:.2f}" for m in of[k]) for of in (truth.centers_m, truth.sizes_m)]
        rows.append((k, names[index], len(boxes), share, *place))
    columns = ("object", "class", "views", "share of image", "centre, m", "size, m")
    table = make_table(columns, rows)
    table.title = room_id
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
        parts.append("no object could be compared with its masks in 3D")
    elif "found" in found.agreement.tallies:
        parts.append(
            "boxes found from masks cannot show whether everything is too large, too small or "
            "mirrored"
        )
    return "; ".join(parts) + "."

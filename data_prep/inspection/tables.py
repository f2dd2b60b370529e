"""The tables and sentences that `sceneprior inspect` prints."""

from collections import Counter
from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path

from rich.table import Column, Table

from data_prep.engine.report import make_table
from data_prep.inspection.agreement import KINDS
from data_prep.inspection.causes import CHANCE, GIVEN
from data_prep.inspection.diagnosis import what_was_checked
from data_prep.inspection.pictures import choose_views
from data_prep.inspection.verify import FolderCheck, RoomCheck, agreement_of, evidence_of
from sceneprior.core.classes import label_set
from sceneprior.core.shards import Shard, iterate_rooms, read_index, splits_of

_WORST_SHOWN = 5


def count_tables(folder: Path) -> list[Table]:
    """Tables of the counts per split, and of the objects per class."""
    names = label_set(read_index(folder)["label_set"])
    totals, classes = [], {}
    turned: list[float] = []
    for split in splits_of(folder):  # made with --only, a folder lacks some
        rooms, known = [], 0
        for shard, room_id in iterate_rooms(folder, split):
            rooms.append(room := shard.read_room(room_id))
            turned += [abs(room.turned_deg)] if room.turned_deg else []
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
    table = make_table(columns, totals)
    if turned:
        table.caption = (
            f"{len(turned)} rooms were turned to lie along their walls and furniture, by "
            f"{min(turned):.1f} to {max(turned):.1f} degrees."
        )
    return [table, make_table(("class", *classes), rows)]


def room_table(folder: Path, room_id: str) -> Table:
    """Table of one room's objects, numbered as in its images; `share` is the mean area of an
    object's 2D boxes."""
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
        rows.append((k + 1, names[index], len(boxes), share, *place))
    columns = ("object", "class", "views", "share of image", "centre, m", "size, m")
    table = make_table(columns, rows)
    turned = f" (turned by {views.turned_deg:.2f} degrees)" if views.turned_deg else ""
    table.title = f"{room_id}{turned}"
    return table


def check_tables(found: FolderCheck) -> list[Table]:
    """Results of a check: each split, and the rooms that agree least.

    Cells are the agreement of masks and cameras, the type of 3D representation, the share of masks
    within their projections, and the mean IoU of fully visible objects.
    """

    def fit_of(checks: Sequence[RoomCheck]) -> list[float]:
        evidence = evidence_of(checks)
        return [evidence.share(GIVEN)] if evidence is not None and evidence.spare else []

    def judged(checks: Sequence[RoomCheck]) -> list[str]:
        cells = [
            (
                KINDS[kind],
                f"{tally.share:.1%} of {tally.masks}",
                f"{tally.mean_iou:.3f} of {tally.whole}" if tally.whole else "-",
            )
            for kind, tally in agreement_of(checks).items()
        ]
        fit = [f"{share:.2f}" for share in fit_of(checks)] or ["-"]
        return fit + (["\n".join(lines) for lines in zip(*cells, strict=True)] or ["-"] * 3)

    totals = []
    for split, checks in found.rooms.items():
        rooms = [check for check in checks if check.room_id]
        views, sums = sum(room.views for room in rooms), sum(room.has_checksum for room in rooms)
        totals.append((split, len(rooms), views, f"{sums} rooms", *judged(checks)))
    columns = ("fit of cameras", "in 3D", "masks within", "mean 2D IoU")
    tables = [make_table(("split", "rooms", "views", "checksums", *columns), totals)]
    lowest = []
    for check in found.every:
        if shares := [*(tally.share for tally in check.agreement.values()), *fit_of([check])]:
            lowest.append((min(shares), check))
    if lowest:
        worst = [check for _, check in sorted(lowest, key=itemgetter(0))[:_WORST_SHOWN]]
        # Ids are folded, because their ends, the rooms' names, must survive narrow terminals.
        named = Column("worst rooms", overflow="fold")
        rows = [(check.room_id, *judged([check])) for check in worst]
        tables.append(make_table((named, *columns), rows))
    return tables


def verdict(found: FolderCheck) -> str:
    """First problem of a folder; or else a sentence that names what could not be checked."""
    if found.problems:
        more = len(found.problems) - 1
        return found.problems[0] + f" ({more} more: run inspect --verify)" * bool(more)
    evidence = evidence_of(found.every)
    assert evidence is not None, "a folder without problems has evidence"
    tallies = agreement_of(found.every)
    in_3d = any(tally.whole for tally in tallies.values())
    unchecked = [] if in_3d else what_was_checked(evidence)[1]
    if not tallies:
        scales = [room.evidence.scale for room in found.every if room.evidence]
        if evidence.scale is None:
            sized = sum(bool(size.name) for size in evidence.sizes)
            unchecked.append(f"the scale ({sized} objects of known size)")
        elif alone := scales.count(None):
            unchecked.append(f"the scale of {alone} rooms, each for itself (too few objects)")
        unchecked += ["the height of the floor"] * (evidence.floor_m is None)
        unchecked.append("whether all pictures are mirror images")
    unchecked += found.without_class
    left = f"nothing wrong is found, but these could not be checked: {', '.join(unchecked)}."
    return left if unchecked else "all is well."


def summary(found: FolderCheck) -> str:
    """State which checks a folder without problems has passed, and which were not possible."""
    evidence = evidence_of(found.every)
    assert evidence is not None, "a folder without problems has evidence"
    yes, scale = what_was_checked(evidence)[0], evidence.scale
    parts = [f"{verdict(found)} Checksums, shapes, ranges, 2D boxes and masks agree"]
    if without := sum(not check.has_checksum for check in found.every):
        parts.append(f"{without} rooms carry no checksum (shards of an earlier release)")
    for kind, tally in agreement_of(found.every).items():
        text = f"{tally.share:.1%} of {tally.masks} masks lie within their projected {KINDS[kind]}"
        if tally.whole:
            text += f"; {tally.whole} unoccluded ones have a mean 2D IoU of {tally.mean_iou:.3f}"
        parts.append(text)
    parts.append(evidence.counts)
    if yes:
        parts.append(
            f"masks and cameras agree by {evidence.share(GIVEN):.2f} of 1 (shuffled cameras: "
            f"{evidence.share(CHANCE):.2f}), which excludes {', '.join(yes)}"
        )
    else:
        parts.append(f"{evidence.spare} measurements to spare; too few views show whole objects")
    if scale is not None:
        parts.append(
            f"{scale}, which excludes lengths {scale.bound:.2g} times too long or too short"
        )
    return "; ".join(parts) + "."

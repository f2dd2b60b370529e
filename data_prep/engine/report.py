"""The outcome of every room, as written to report.json and report.csv; deterministic."""

import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from data_prep.engine.source import SPLITS, Expected, LeftOut, PreparedRoom, RoomTask
from sceneprior.core.classes import label_set

_COLUMNS = ("room_id", "house", "split", "status", "rule", "reason", "views", "objects", "notes")


@dataclass
class Line:
    """One line of the report: a room, or a house that could not be read."""

    room_id: str
    house: str
    status: str
    """prepared, filtered or failed."""
    rule: str = ""
    """Rule that filtered the room."""
    reason: str = ""
    split: str = ""
    views: int = 0
    objects: int = 0
    """Tracked objects: those visible in at least one view."""
    visible: int = 0
    """Objects visible in a view, summed over the views."""
    notes: list[str] = field(default_factory=list)
    """Parts of the room that were left out, with reasons."""
    classes: dict[str, int] = field(default_factory=dict)
    """Tracked objects of each class."""
    unknown_categories: dict[str, int] = field(default_factory=dict)
    """Number of pieces per unknown category; see `PreparedRoom`."""


def line_of(
    result: PreparedRoom | LeftOut, task: RoomTask | None = None, label_set_name: str = ""
) -> Line:
    """Line of a prepared room, or of one left out by the survey (no task) or later."""
    if isinstance(result, LeftOut):
        return Line(
            result.room_id, result.house, result.status, result.rule, result.reason,
            split=task.split if task else "", notes=list(result.notes),
            unknown_categories=dict(result.unknown_categories),
        )  # fmt: skip
    assert task is not None
    names = label_set(label_set_name)
    views = result.views
    return Line(
        task.room_id,
        task.house,
        "prepared",
        split=task.split,
        views=len(views.boxes),
        objects=len(views.object_class),
        visible=int(views.visible.sum()),
        notes=list(result.notes),
        classes=dict(Counter(names[index] for index in views.object_class)),
        unknown_categories=dict(result.unknown_categories),
    )


def count_splits(lines: Iterable[Line]) -> dict[str, dict[str, int]]:
    """Numbers of rooms, views and objects per split."""
    prepared = [line for line in lines if line.status == "prepared"]
    return {
        split: {
            "rooms": sum(line.split == split for line in prepared),
            "views": sum(line.views for line in prepared if line.split == split),
            "objects": sum(line.objects for line in prepared if line.split == split),
        }
        for split in SPLITS
    }


def make_report(
    lines: Sequence[Line], about: dict[str, Any], expected: Expected | None = None
) -> dict[str, Any]:
    """Build the report of a job; it does not depend on time, workers or interruptions.

    Args:
        lines: One per room considered.
        about: Entries at the top of the report, such as source, recipe and renderer.
        expected: Counts stated in the recipe, for comparison.
    """
    prepared = [line for line in lines if line.status == "prepared"]
    filtered: dict[str, list[str]] = {}
    for line in lines:
        if line.status == "filtered":
            filtered.setdefault(line.rule, []).append(line.room_id)
    report = {
        "format": "sceneprior-report",
        "version": 1,
        **about,
        "found": len(lines),
        "statuses": dict(sorted(Counter(line.status for line in lines).items())),
        "filtered": {
            rule: {"rooms": len(ids), "room_ids": ids} for rule, ids in sorted(filtered.items())
        },
        "failed": [
            {"room_id": line.room_id, "house": line.house, "reason": line.reason}
            for line in lines
            if line.status == "failed"
        ],
        "with_notes": sum(bool(line.notes) for line in prepared),
        "notes": _kinds_of_notes(prepared),
        "counts": count_splits(lines),
        "per_split": {
            split: _means([line for line in prepared if line.split == split]) for split in SPLITS
        },
        "classes": _classes(prepared),
        "unknown_categories": _sums(line.unknown_categories for line in lines),
    }
    if expected is not None:
        report["expected"] = {"of": expected.of, "rows": compare(expected, prepared)}
    return report | {"rooms": [asdict(line) for line in lines]}


def compare(expected: Expected, prepared: Sequence[Line]) -> list[dict[str, Any]]:
    """Compare each count stated in the recipe: one row of name, expected, found, difference."""
    found = {
        "rooms": len(prepared),
        **{split: sum(line.split == split for line in prepared) for split in SPLITS},
        "views": sum(line.views for line in prepared),
        "objects": sum(line.objects for line in prepared),
    }
    return [
        {"what": what, "expected": count, "found": found[what], "difference": found[what] - count}
        for what, count in expected.model_dump().items()
        if what != "of" and count is not None
    ]


def _kinds_of_notes(lines: Sequence[Line]) -> dict[str, int]:
    """Numbers of rooms per kind of note (names and numbers masked), most frequent first."""
    kinds: Counter[str] = Counter()
    for line in lines:
        kinds.update({re.sub(r"'[^']*'|\S*\d\S*", "...", note) for note in line.notes})
    return dict(sorted(kinds.items(), key=lambda item: (-item[1], item[0])))


def _means(lines: Sequence[Line]) -> dict[str, Any]:
    rooms = max(len(lines), 1)
    views = sum(line.views for line in lines)
    return {
        "views_per_room": round(views / rooms, 3),
        "objects_per_room": round(sum(line.objects for line in lines) / rooms, 3),
        "objects_per_view": round(sum(line.visible for line in lines) / max(views, 1), 3),
        "rooms_of_so_many_objects": {
            str(count): rooms
            for count, rooms in sorted(Counter(line.objects for line in lines).items())
        },
        "classes": _classes(lines),
    }


def _classes(lines: Iterable[Line]) -> dict[str, int]:
    return _sums(line.classes for line in lines)


def _sums(counts: Iterable[dict[str, int]]) -> dict[str, int]:
    total: Counter[str] = Counter()
    for one in counts:
        total.update(one)
    return dict(sorted(total.items()))


def report_csv(lines: Iterable[Line]) -> str:
    """CSV table with one row per room, for spreadsheets and grep."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for line in lines:
        row = asdict(line) | {"notes": " | ".join(line.notes)}
        writer.writerow([row[column] for column in _COLUMNS])
    return table.getvalue()

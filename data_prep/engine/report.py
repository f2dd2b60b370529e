"""The outcome of every room: as report.json, as report.csv, and as tables for the terminal."""

import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from pydantic import BaseModel
from rich.table import Column, Table
from rich.text import Text

from data_prep.engine.source import Line, PreparedRoom, RoomTask, Source
from sceneprior.core.checked import shown
from sceneprior.core.classes import label_set
from sceneprior.core.shards import INDEX_NAME, SPLITS

REPORT_NAME = "report.json"
TABLE_NAME = "report.csv"
REPORT_FILES = (INDEX_NAME, REPORT_NAME, TABLE_NAME)
"""Files of a finished folder, in the order of their deletion when work begins again."""
_NAMED = 5
_SHOWN = 10
"""Number of notes, and of failures, that the terminal shows."""
_COUNTS = ("rooms", "views", "objects")
_MEANS = ("views_per_room", "objects_per_room", "objects_per_view")
_COLUMNS = ("room_id", "house", "split", "status", "rule", "reason", "views", "objects", "notes")


class Report(BaseModel):
    """The entries of `report.json` that are read again."""

    rooms: list[Line]


def line_of(result: PreparedRoom | Line, task: RoomTask, label_set_name: str) -> Line:
    """Report line of a room that was prepared or left out, with the room's split."""
    if isinstance(result, Line):
        return replace(result, split=task.split)
    names, views = label_set(label_set_name), result.views
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
        cameras=dict(result.cameras),
    )


def count_splits(lines: Iterable[Line]) -> dict[str, dict[str, int]]:
    """Numbers of rooms, views and objects per split."""
    counts = {split: dict.fromkeys(_COUNTS, 0) for split in SPLITS}
    for line in lines:
        if line.status == "prepared":
            for name, count in zip(_COUNTS, (1, line.views, line.objects), strict=True):
                counts[line.split][name] += count
    return counts


def make_report(lines: Sequence[Line], about: dict[str, Any]) -> dict[str, Any]:
    """Build the report of a job, with the entries `about` at its top.

    It does not depend on time, workers or interruptions.
    """
    prepared = [line for line in lines if line.status == "prepared"]
    filtered: dict[str, list[str]] = {}
    for line in lines:
        if line.status == "filtered":
            filtered.setdefault(line.rule, []).append(line.room_id)
    kinds_of_notes: Counter[str] = Counter()  # names and numbers are masked
    for line in prepared:
        kinds_of_notes.update({re.sub(r"'[^']*'|\S*\d\S*", "...", note) for note in line.notes})
    return {
        "format": "sceneprior-report",
        "version": 1,
        **about,
        "found": len(lines),
        "statuses": _sums({line.status: 1} for line in lines),
        "filtered": {
            rule: {"rooms": len(ids), "room_ids": ids} for rule, ids in sorted(filtered.items())
        },
        "failed": [
            {"room_id": line.room_id, "house": line.house, "reason": line.reason}
            for line in lines
            if line.status == "failed"
        ],
        "with_notes": sum(bool(line.notes) for line in prepared),
        "notes": dict(_most_first(kinds_of_notes)),
        "counts": (counts := count_splits(lines)),
        "per_split": {
            split: _means(counts[split], [line for line in prepared if line.split == split])
            for split in SPLITS
        },
        "classes": _sums(line.classes for line in prepared),
        "unknown_categories": _sums(line.unknown_categories for line in lines),
        "rooms": [asdict(line) for line in lines],
    }


def _means(counts: dict[str, int], lines: Sequence[Line]) -> dict[str, Any]:
    rooms, views = max(counts["rooms"], 1), max(counts["views"], 1)
    of_sizes = sorted(Counter(line.objects for line in lines).items())
    return {
        "views_per_room": round(counts["views"] / rooms, 3),
        "objects_per_room": round(counts["objects"] / rooms, 3),
        "objects_per_view": round(sum(line.visible for line in lines) / views, 3),
        "rooms_of_so_many_objects": {str(objects): count for objects, count in of_sizes},
        "classes": _sums(line.classes for line in lines),
    }


def _sums(counts: Iterable[dict[str, int]]) -> dict[str, int]:
    total: Counter[str] = Counter()
    for one in counts:
        total.update(one)
    return dict(sorted(total.items()))


def _most_first(counts: dict[str, int]) -> list[tuple[str, int]]:
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))


def report_csv(lines: Iterable[Line]) -> str:
    """CSV table with one row per room, for spreadsheets and grep."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for line in lines:
        row = asdict(line) | {"notes": " | ".join(line.notes)}
        writer.writerow([row[column] for column in _COLUMNS])
    return table.getvalue()


def _compared(of: str, official: dict[str, int], counts: dict[str, Any]) -> dict[str, Any]:
    found = {split: count["rooms"] for split, count in counts.items()} | _sums(counts.values())
    rows = [
        {"what": what, "expected": count, "found": found[what], "difference": found[what] - count}
        for what, count in official.items()
    ]
    return {"of": of, "rows": rows}


@dataclass(frozen=True)
class Summary:
    """The totals of a job."""

    source: Source
    lines: list[Line]
    """One line per room considered; with `--only` in a larger folder, one per requested room."""
    renderer: str | None
    """Name of the renderer; None if nothing was drawn."""
    shards_made: int
    shards_kept: int
    shards_open: int
    """Planned shards that `--only` left for later; the folder is unfinished while there are any."""

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Numbers of rooms, views and objects per split."""
        return count_splits(self.lines)

    @property
    def statuses(self) -> dict[str, int]:
        """Numbers of rooms that were prepared, filtered, failed."""
        return dict(Counter(line.status for line in self.lines))

    @property
    def report(self) -> dict[str, Any]:
        """Contents of `report.json`."""
        about: dict[str, Any] = {
            "source": self.source.name,
            "room_type": self.source.room_type,
            "label_set": self.source.label_set,
            "renderer": self.renderer,
            "summary": str(self),
        }
        if self.source.official is not None:
            about["expected"] = _compared(*self.source.official, self.counts)
        return make_report(self.lines, about)

    def __str__(self) -> str:
        parts = [
            f"{split} {count['rooms']} rooms, {count['views']} views, {count['objects']} objects"
            for split, count in self.counts.items()
            if count["rooms"]
        ]
        left_out = ", ".join(
            f"{self.statuses[status]} {status}"
            for status in ("filtered", "failed")
            if self.statuses.get(status)
        )
        parts += [f"{left_out} ({TABLE_NAME} says why)"] * bool(left_out)
        if self.source.label_set.startswith("void,"):  # the user's own list
            there = {name for line in self.lines for name in line.classes}
            empty = [name for name in label_set(self.source.label_set)[1:] if name not in there]
            parts += [f"no object is {' or '.join(empty)}"] * bool(empty)
        return "; ".join([*parts, *without_class(self.lines)])


def without_class(lines: Iterable[Line]) -> list[str]:
    """A phrase on what has a name that is no class of the label set; empty if there is none."""
    counts = _most_first(_sums(line.unknown_categories for line in lines))
    named = ", ".join(shown(name) for name, _ in counts[:_NAMED])
    more = ", ..." if len(counts) > _NAMED else ""
    total = sum(count for _, count in counts)
    return [f"{total} objects whose name is no class ({named}{more})"] * bool(counts)


def make_table(
    columns: Iterable[Column | str], rows: Iterable[Iterable[Any]], caption: str | None = None
) -> Table:
    """Format rows of texts and numbers as a table."""
    table = Table(*columns, caption=caption)
    for row in rows:
        # Cells are `Text`, because rich parses [brackets] in plain strings as markup.
        table.add_row(*(Text(str(cell)) for cell in row))
    return table


def report_tables(report: dict[str, Any]) -> list[Table]:
    """Format the report of `make_report` as tables."""
    means, statuses = report["per_split"], report["statuses"]
    outcomes = [
        ("found", report["found"]),
        ("prepared", statuses.get("prepared", 0)),
        *((f"filtered by {rule}", group["rooms"]) for rule, group in report["filtered"].items()),
        ("failed", statuses.get("failed", 0)),
        *[("prepared with notes", report["with_notes"])] * bool(report["with_notes"]),
    ]
    splits = [
        (split, *(counts[key] for key in _COUNTS), *(f"{means[split][key]:.2f}" for key in _MEANS))
        for split, counts in report["counts"].items()
    ]
    classes = [
        (name, *(means[split]["classes"].get(name, 0) for split in report["counts"]))
        for name, _ in _most_first(report["classes"])
    ]
    columns = ("split", *_COUNTS, *(name.replace("_", " ") for name in _MEANS))
    tables = [
        make_table(("rooms", ""), outcomes),
        make_table(columns, splits),
        make_table(("class", *report["counts"]), classes),
    ]
    if expected := report.get("expected"):
        cells = [[*row.values()] for row in expected["rows"]]
        rows = [(*others, f"{more:+d}" if more else "as expected") for *others, more in cells]
        tables.append(make_table(("what", "expected", "found", "difference"), rows, expected["of"]))

    def add_some(name: str, other: str, rows: list[tuple[str, Any]], more: tuple[str, str]) -> None:
        if rows:
            cells = rows[:_SHOWN] + [more] * (len(rows) > _SHOWN)
            tables.append(make_table((Column(name, overflow="fold"), other), cells))

    notes = [*report["notes"].items()]
    more = f"and {len(notes) - _SHOWN} more: report.csv", ""
    add_some("note of prepared rooms", "rooms", notes, more)
    if unknown := _most_first(report["unknown_categories"]):
        why = "counted as void: neither label set nor recipe lists them"
        tables.append(make_table(("category without a class", "pieces"), unknown, why))
    failed = [(item["room_id"], item["reason"]) for item in report["failed"]]
    more = f"and {len(failed) - _SHOWN} more", "report.csv lists all of them"
    add_some("failed", "why", failed, more)
    return tables

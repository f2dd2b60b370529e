"""The report of a job as tables for the terminal."""

from typing import Any

from rich.table import Column, Table
from rich.text import Text

_FAILURES_SHOWN = 10
_NOTES_SHOWN = 10
_COUNTS = ("rooms", "views", "objects")


def report_tables(report: dict[str, Any]) -> list[Table]:
    """Format the report of `make_report` as tables, from outcomes to expected counts."""
    tables = [_outcome(report), _splits(report), _classes(report)]
    if report["notes"]:
        tables.append(_notes(report["notes"]))
    if report["unknown_categories"]:
        tables.append(_unknown(report["unknown_categories"]))
    if report["failed"]:
        tables.append(_failures(report["failed"]))
    if "expected" in report:
        tables.append(_expected(report["expected"]))
    return tables


def _outcome(report: dict[str, Any]) -> Table:
    table = Table("rooms", "")
    table.add_row("found", str(report["found"]))
    table.add_row("prepared", str(report["statuses"].get("prepared", 0)))
    for rule, group in report["filtered"].items():
        table.add_row(f"filtered by {rule}", str(group["rooms"]))
    table.add_row("failed", str(report["statuses"].get("failed", 0)))
    if report["with_notes"]:
        table.add_row("prepared with notes", str(report["with_notes"]))
    return table


def _notes(kinds: dict[str, int]) -> Table:
    table = Table(Column("note of prepared rooms", overflow="fold"), "rooms")
    for note, rooms in list(kinds.items())[:_NOTES_SHOWN]:
        table.add_row(Text(note), str(rooms))
    if len(kinds) > _NOTES_SHOWN:
        table.add_row(f"and {len(kinds) - _NOTES_SHOWN} more: report.csv", "")
    return table


def _splits(report: dict[str, Any]) -> Table:
    keys = ("views_per_room", "objects_per_room", "objects_per_view")
    table = Table("split", *_COUNTS, "views a room", "objects a room", "objects a view")
    for split, counts in report["counts"].items():
        means = [f"{report['per_split'][split][key]:.2f}" for key in keys]
        table.add_row(split, *(str(counts[key]) for key in _COUNTS), *means)
    return table


def _classes(report: dict[str, Any]) -> Table:
    splits = list(report["counts"])
    table = Table("class", *splits)
    for name, _ in sorted(report["classes"].items(), key=lambda item: (-item[1], item[0])):
        per_split = [report["per_split"][split]["classes"].get(name, 0) for split in splits]
        table.add_row(name, *map(str, per_split))
    return table


def _unknown(pieces: dict[str, int]) -> Table:
    table = Table("category without a class", "pieces", caption="void: the recipe does not say")
    for name, count in sorted(pieces.items(), key=lambda item: (-item[1], item[0])):
        table.add_row(Text(name), str(count))
    return table


def _failures(failed: list[dict[str, str]]) -> Table:
    table = Table(Column("failed", overflow="fold"), "why")
    for item in failed[:_FAILURES_SHOWN]:
        # Text, because rich parses [brackets] in plain strings as markup.
        table.add_row(Text(item["room_id"]), Text(item["reason"]))
    if len(failed) > _FAILURES_SHOWN:
        table.add_row(f"and {len(failed) - _FAILURES_SHOWN} more", "report.csv has them all")
    return table


def _expected(expected: dict[str, Any]) -> Table:
    table = Table("count", "expected", "found", "difference", caption=expected["of"] or None)
    for row in expected["rows"]:
        difference = f"{row['difference']:+d}" if row["difference"] else "as expected"
        table.add_row(row["what"], str(row["expected"]), str(row["found"]), difference)
    return table

"""The report of a job as tables for the terminal."""

from collections.abc import Iterable
from typing import Any

from rich.table import Column, Table
from rich.text import Text

_FAILURES_SHOWN = 10
_NOTES_SHOWN = 10
_COUNTS = ("rooms", "views", "objects")
_MEANS = ("views_per_room", "objects_per_room", "objects_per_view")


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
    """Format the report of `make_report` as tables, from outcomes to expected counts."""
    means, statuses = report["per_split"], report["statuses"]
    outcomes = [
        ("found", report["found"]),
        ("prepared", statuses.get("prepared", 0)),
        *((f"filtered by {rule}", group["rooms"]) for rule, group in report["filtered"].items()),
        ("failed", statuses.get("failed", 0)),
    ]
    if report["with_notes"]:
        outcomes.append(("prepared with notes", report["with_notes"]))
    splits = [
        (split, *(counts[key] for key in _COUNTS), *(f"{means[split][key]:.2f}" for key in _MEANS))
        for split, counts in report["counts"].items()
    ]
    classes = [
        (name, *(means[split]["classes"].get(name, 0) for split in report["counts"]))
        for name, _ in _most_first(report["classes"])
    ]
    tables = [
        make_table(("rooms", ""), outcomes),
        make_table(
            ("split", *_COUNTS, "views per room", "objects per room", "objects per view"), splits
        ),
        make_table(("class", *report["counts"]), classes),
    ]
    if notes := [*report["notes"].items()]:
        more = [(f"and {len(notes) - _NOTES_SHOWN} more: report.csv", "")]
        rows = notes[:_NOTES_SHOWN] + more * (len(notes) > _NOTES_SHOWN)
        about = Column("note of prepared rooms", overflow="fold")
        tables.append(make_table((about, "rooms"), rows))
    if unknown := _most_first(report["unknown_categories"]):
        why = "counted as void: the recipe does not list them"
        tables.append(make_table(("category without a class", "pieces"), unknown, why))
    if failed := [(item["room_id"], item["reason"]) for item in report["failed"]]:
        more = [(f"and {len(failed) - _FAILURES_SHOWN} more", "report.csv lists all of them")]
        rows = failed[:_FAILURES_SHOWN] + more * (len(failed) > _FAILURES_SHOWN)
        tables.append(make_table((Column("failed", overflow="fold"), "why"), rows))
    if "expected" in report:
        rows = [
            (row["what"], row["expected"], row["found"],
             f"{row['difference']:+d}" if row["difference"] else "as expected")
            for row in report["expected"]["rows"]
        ]  # fmt: skip
        columns = ("count", "expected", "found", "difference")
        tables.append(make_table(columns, rows, report["expected"]["of"] or None))
    return tables


def _most_first(counts: dict[str, int]) -> list[tuple[str, int]]:
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))

"""Tables of rows as Markdown, CSV and an HTML page with sortable columns; marks of best values."""

import csv
import io
from collections.abc import Iterator, Sequence
from math import isnan, nan
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

import numpy as np

from sceneprior.apps.experiments.comparison import LIFTED, PAPER
from sceneprior.apps.experiments.rows import COSTS, FEW, REFERENCE, UNRANKED, Form, Result, Row
from sceneprior.core.files import write_whole
from sceneprior.evaluation.metric import EMPTY, Direction, TableColumn
from sceneprior.evaluation.page import render

GAP = "–"
"""An undefined or unknown value."""
FACTORS = {"cpu_s": 1 / 60, "parameters": 1e-6}
"""Factors from the units of costs to those of the table."""
BEST, TIED = "best", "tied"
"""Marks of the best value of a column, if its interval is apart from those of all other rows; and
else of that value and of all whose intervals overlap with its interval."""
LEGEND = (
    "Bold: the best of the ranked rows, and its interval overlaps with that of no other. ≈: the "
    "best value, or one that cannot be told apart from it, because their intervals overlap. –: "
    "undefined or not measured. [from, to]: 95% interval. A value of several seeds is their mean ± "
    "half their range; its interval spans those of all seeds. Reference rows, decoded training "
    "rooms and copies are not ranked, nor are columns without intervals."
)


class Cell(NamedTuple):
    """A value of a table."""

    text: str
    value: float | None = None
    mark: str = ""
    """`BEST`, `TIED` or empty."""

    @property
    def markdown(self) -> str:
        """The text with its mark."""
        if self.mark != BEST:
            return "≈ " * (self.mark == TIED) + self.text
        value, _, interval = self.text.partition(" ")
        return f"**{value}** {interval}".strip()


class Line(NamedTuple):
    """A line of a table."""

    title: str
    variant: str
    group: str
    found: Sequence[Result]
    """The scores of each seed."""
    cells: Sequence[Cell] = ()


class Table(NamedTuple):
    """A table with its headings."""

    title: str
    warnings: list[str]
    caption: str
    columns: dict[str, TableColumn]
    references: list[Line]
    lines: list[Line]

    @property
    def ranked(self) -> list[Line]:
        """The lines of methods that are compared with each other, of all groups."""
        return [line for line in self.lines if line.group not in UNRANKED]

    @property
    def unranked(self) -> list[Line]:
        """The lines of decoded training rooms and of copies."""
        return [line for line in self.lines if line.group in UNRANKED]


def write_tables(rows: Sequence[Row], form: Form, out: Path) -> None:
    """Write `table.md`, `table.html` and `table.csv` (one line per run and variant)."""
    tables = [table_of(own, form) for own in _by(rows, "rooms")]
    write_whole(out / "table.md", markdown(tables, form))
    write_whole(out / "table.csv", as_csv(rows, form))
    title = "Comparison of methods"
    page = render("table.html.jinja", title=title, tables=tables, notes=_notes(form), legend=LEGEND)
    write_whole(out / "table.html", page.encode())


def table_of(rows: Sequence[Row], form: Form) -> Table:
    """The table of one kind of rooms: its references, and a line for each title and variant."""
    columns = {
        key: column
        for key, column in (form.columns | COSTS).items()
        if any(key in row.scores for row in rows)
    }
    # The first result may be older than a set of rooms that later ones have.
    found: dict[str, Result] = {
        title: next((row.scores[name] for row in rows if name in row.scores), {})
        for title, name in form.references.items()
    }
    references = [
        Line(title, GAP, REFERENCE, [scores])
        for title, scores in found.items()
        if any(scores.get(key) is not None for key in columns)
    ]
    lines = [
        Line(runs[0].title, runs[0].variant, runs[0].group, [row.scores for row in runs])
        for runs in _by(sorted(rows, key=lambda row: row.rank), "group", "title", "variant")
    ]
    return Table(
        rows[0].rooms, _warnings(rows), _caption(rows, form), columns,
        _with_cells(references, columns), _with_cells(lines, columns),
    )  # fmt: skip


# -- Values and their marks ------------------------------------------------------------------------


def _with_cells(lines: list[Line], columns: dict[str, TableColumn]) -> list[Line]:
    """The lines with their cells; those of references and of `UNRANKED` groups have no marks."""
    found = [[_cell(line.found, key, of) for key, of in columns.items()] for line in lines]
    ranked = [k for k, line in enumerate(lines) if line.group not in UNRANKED]
    for number, (key, column) in enumerate(columns.items()):
        spans = {k: _span(lines[k].found, key, column.direction) for k in ranked}
        for k, mark in _marks({k: span for k, span in spans.items() if span}).items():
            found[k][number] = found[k][number]._replace(mark=mark)
    return [line._replace(cells=cells) for line, cells in zip(lines, found, strict=True)]


def _span(
    found: Sequence[Result], key: str, direction: Direction
) -> tuple[float, float, float] | None:
    """Distance of a value from the ideal, and the interval of this distance, all seeds together.

    None if the value is undefined, or the column has no better direction; NaN ends if the value has
    no interval.
    """
    known = [scores[key] for scores in found if scores.get(key) is not None]
    if not known or direction == "none":
        return None
    intervals = [scores.get("intervals", {}).get(key) for scores in found]
    ends = [end for each in intervals for end in each or (nan, nan)]
    value, low, high = map(float, (mean(known), np.min(ends), np.max(ends)))
    if direction == "half":
        near, far = sorted((abs(low - 0.5), abs(high - 0.5)))
        return abs(value - 0.5), 0.0 if low <= 0.5 <= high else near, far
    return (-value, -high, -low) if direction == "higher" else (value, low, high)


def _marks(spans: dict[int, tuple[float, float, float]]) -> dict[int, str]:
    """The marks of the rows with a value; none for a single row, or if one has no interval."""
    if len(spans) < 2 or any(isnan(low) for _, low, _ in spans.values()):
        return {}
    best = min(spans, key=lambda row: spans[row][0])
    tied = [row for row, (_, low, _) in spans.items() if low <= spans[best][2]]
    return {best: BEST} if tied == [best] else dict.fromkeys(tied, TIED)


def _cell(found: Sequence[Result], key: str, column: TableColumn) -> Cell:
    """The mean of a value over seeds, with half its range, or one value with its interval."""
    known = [scores[key] for scores in found if scores.get(key) is not None]
    values = [float(value) * FACTORS.get(key, 1.0) for value in known]
    if not values:
        return Cell(GAP)
    middle = f"{mean(values):,.{column.digits}f}"
    if len(found) == 1 and (interval := found[0].get("intervals", {}).get(key)):
        low, high = (f"{end:,.{column.digits}f}" for end in interval)
        return Cell(f"{middle} [{low}, {high}]", values[0])
    if len(values) == 1 or key in COSTS:
        return Cell(middle, mean(values))
    around = (max(values) - min(values)) / 2
    return Cell(f"{middle} ± {around:.{column.digits}f}", mean(values))


# -- Files -----------------------------------------------------------------------------------------


def markdown(tables: Sequence[Table], form: Form) -> str:
    """A Markdown table for each kind of rooms, with methods under the headings of their groups."""
    parts = [
        f"### {table.title}\n\n"
        + "".join(f"**Warning:** {each}.\n\n" for each in table.warnings)
        + f"{table.caption}\n\n"
        + "\n".join(f"| {' | '.join(cells)} |" for cells in _rows(table, form))
        for table in tables
    ]
    return "\n\n".join([*parts, f"{_notes(form)}. {LEGEND}"]) + "\n"


def _rows(table: Table, form: Form) -> Iterator[list[str]]:
    """The cells of each row of a Markdown table, including its head and the headings of groups."""
    yield ["method", form.variant, *(column.heading for column in table.columns.values())]
    yield ["---", "---", *["---:"] * len(table.columns)]
    group = None
    for line in (*table.references, *table.lines):
        if line.group != group:
            group = line.group
            yield [f"*{group}*", *[""] * (len(table.columns) + 1)]
        yield [line.title, line.variant, *(cell.markdown for cell in line.cells)]


def as_csv(rows: Sequence[Row], form: Form) -> str:
    """One line per run and variant, with unrounded numbers, and the 95% intervals at the end."""
    keys = [*form.columns, *COSTS]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    ends = [f"{key} {end}" for key in form.columns for end in ("from", "to")]
    writer.writerow(["rooms", "group", "method", "made by", form.variant, "seed", *keys, *ends])
    for row in rows:
        named = [row.rooms, row.group, row.title, row.made_by, row.variant, row.seed]
        intervals = row.scores.get("intervals", {})
        between = [end for key in form.columns for end in intervals.get(key) or (None, None)]
        writer.writerow([*named, *(row.scores.get(key) for key in keys), *between])
    return text.getvalue()


def _notes(form: Form) -> str:
    """The notes on the columns."""
    return "; ".join(column.note for column in form.columns.values() if column.note)


def _by(rows: Sequence[Row], *names: str) -> list[list[Row]]:
    """Rows with equal values of these fields, in the order of their first rows."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(getattr(row, name) for name in names), []).append(row)
    return list(groups.values())


def _warnings(rows: Sequence[Row]) -> list[str]:
    """Sentences on what makes a table's values uncertain or meaningless."""
    protocol, found = rows[0].scores["protocol"], dict[str, None]()
    if apart := protocol.get("apart"):
        found[apart] = None
    if (count := protocol.get("n_test", FEW)) < FEW:
        found[f"with {count} test rooms, rows whose intervals overlap cannot be told apart"] = None
    for row in rows:
        if EMPTY in (note := row.scores.get("note", "")):
            found[f"'{row.title}', {row.variant}: {note.partition(':')[0]}"] = None
    return list(found)


def _caption(rows: Sequence[Row], form: Form) -> str:
    """The sentences above a table: the method of each row, the evaluation, and the seeds."""
    seeds = sorted({row.seed for row in rows})
    said = f"{form.say(rows[0].scores)}; seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}."
    if not any(row.made_by for row in rows):
        return said[:1].upper() + said[1:]
    titles: dict[str, dict[str, None]] = {PAPER: {}, LIFTED: {}}
    for row in rows:
        titles.setdefault(row.made_by, {})[f"'{row.title}'"] = None
    parts = (f"of {made_by}: {', '.join(named) or 'none'}" for made_by, named in titles.items())
    return f"Rows {'; '.join(parts)}. {said}"

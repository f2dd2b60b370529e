"""The table of a comparison, as Markdown, CSV and LaTeX, from the scores of its runs.

`Form` says what the columns and the reference rows are, of new rooms or of answers to images.
"""

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Any

from sceneprior.evaluation.metric import ARROWS, Direction, TableColumn
from sceneprior.evaluation.registry import DECODED, METRICS
from sceneprior.files import write_whole

GAP = "–"


@dataclass(frozen=True)
class Row:
    """What one run made: on which rooms, by which method, its scores and what training it took."""

    rooms: str
    group: str
    title: str
    variant: str
    """What sets it apart from other rows of its run (`Form.variant`)."""
    seed: int
    scores: dict[str, Any]
    costs: dict[str, int | float | None]


COSTS = {
    "steps": (TableColumn("steps", 0), 1.0),
    "cpu_s": (TableColumn("CPU min", 1), 1 / 60),
    "parameters": (TableColumn("parameters (M)", 2), 1e-6),
}
"""Columns of what training took, and the factor from the journal's units."""


@dataclass(frozen=True)
class Form:
    """What stands in the tables of one kind of comparison."""

    columns: dict[str, tuple[TableColumn, float]]
    """By key of the scores, and a factor from their unit to the table's; `COSTS` follow."""
    references: dict[str, str]
    """Rows that need no training: (title, where a result keeps their values)."""
    variant: str
    """Heading of the second column."""
    say: Callable[[Sequence[Row]], str]
    """What stands above a table, of its rows."""

    @property
    def keys(self) -> dict[str, tuple[TableColumn, float]]:
        """All columns."""
        return self.columns | COSTS

    @property
    def caption(self) -> str:
        """What stands below all tables."""
        notes = [column.note for column, _ in self.keys.values() if column.note]
        seeds = "A value of several seeds is their mean ± half their range."
        return f"{'; '.join(notes)}. {seeds}"


def arrowed(column: TableColumn, direction: Direction) -> TableColumn:
    """A column whose title tells which values are good."""
    return replace(column, title=column.title + ARROWS[direction])


def _of_new_rooms(rows: Sequence[Row]) -> str:
    protocol = rows[0].scores["protocol"]
    return (
        f"{protocol['n_generated']} generated rooms a run against {protocol['n_test']} test rooms "
        f"of {protocol['shards']}; {protocol['n_train_rooms']} real training rooms; "
        f"seeds {seeds_of(rows)}."
    )


def seeds_of(rows: Sequence[Row]) -> str:
    """The seeds of rows, in words."""
    return ", ".join(map(str, sorted({row.seed for row in rows})))


NEW_ROOMS = Form(
    columns={
        m.key: (arrowed(m.column, m.direction), 1.0) for m in (*METRICS, *DECODED) if m.column
    },
    references={
        "Independent objects, as boxes": "independent",
        "Independent objects, with meshes": "independent_meshes",
        "Shuffled furniture, as boxes": "shuffled",
        "Real training rooms": "train_rooms",
    },
    variant="latents",
    say=_of_new_rooms,
)


def write_tables(rows: Sequence[Row], out: Path, form: Form = NEW_ROOMS) -> None:
    """Write `table.md`, `table.csv` (a line a run) and `table.tex` into a folder."""
    write_whole(out / "table.md", markdown(rows, form).encode())
    write_whole(out / "table.csv", as_csv(rows, form).encode())
    write_whole(out / "table.tex", latex(rows, form).encode())


def markdown(rows: Sequence[Row], form: Form = NEW_ROOMS) -> str:
    """A table for each kind of rooms, methods under the headings of their groups."""
    parts = []
    for rooms, own in _by(rows, lambda row: row.rooms).items():
        columns = _columns(own, form)
        lines = [f"### {rooms}", "", form.say(own), ""]
        titles = " | ".join(form.keys[key][0].title for key in columns)
        lines.append(f"| method | {form.variant} | {titles} |")
        lines.append("| --- | --- |" + " ---: |" * len(columns))
        for cells in _body(own, columns, form):
            if len(cells) == 1:
                lines.append(f"| *{cells[0]}* |" + " |" * (len(columns) + 1))
            else:
                lines.append("| " + " | ".join(cells) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join([*parts, form.caption]) + "\n"


def latex(rows: Sequence[Row], form: Form = NEW_ROOMS) -> str:
    """The same for `booktabs`."""
    parts = []
    for rooms, own in _by(rows, lambda row: row.rooms).items():
        columns = _columns(own, form)
        lines = [
            f"% {rooms}: {form.say(own)}",
            r"\begin{tabular}{ll" + "r" * len(columns) + "}",
            r"\toprule",
            " & ".join(
                ["method", form.variant, *(_tex(form.keys[key][0].title) for key in columns)]
            )
            + r" \\",
        ]
        for first, *cells in ([_tex(cell) for cell in line] for line in _body(own, columns, form)):
            if cells:
                lines.append(" & ".join([first, *cells]) + r" \\")
            else:
                width = len(columns) + 2
                lines.append(rf"\midrule \multicolumn{{{width}}}{{l}}{{\emph{{{first}}}}} \\")
        parts.append("\n".join([*lines, r"\bottomrule", r"\end{tabular}"]))
    return "\n\n".join([*parts, "% " + _tex(form.caption)]) + "\n"


def as_csv(rows: Sequence[Row], form: Form = NEW_ROOMS) -> str:
    """A line a run and variant, numbers in full."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["rooms", "group", "method", form.variant, "seed", *form.keys])
    for row in rows:
        values = [_value(row, key) for key in form.keys]
        told = ["" if value is None else repr(value) for value in values]
        writer.writerow([row.rooms, row.group, row.title, row.variant, row.seed, *told])
    return text.getvalue()


def _columns(rows: Sequence[Row], form: Form) -> list[str]:
    return [key for key in form.keys if any(_value(row, key) is not None for row in rows)]


def _body(rows: Sequence[Row], columns: Sequence[str], form: Form) -> list[list[str]]:
    """The cells of each line; the line of a group's own heading has one cell."""
    lines = [["reference"]]
    for title, name in form.references.items():
        values = rows[0].scores.get(name, {})
        lines.append([title, GAP, *(_cell([values.get(key)], key, form) for key in columns)])
    for group, members in _by(rows, lambda row: row.group).items():
        lines.append([group])
        for runs in _by(members, lambda row: f"{row.title}: {row.variant}").values():
            cells = (_cell([_value(row, key) for row in runs], key, form) for key in columns)
            lines.append([runs[0].title, runs[0].variant, *cells])
    return lines


def _value(row: Row, key: str) -> int | float | None:
    return (row.costs if key in COSTS else row.scores).get(key)


def _cell(found: Sequence[int | float | None], key: str, form: Form) -> str:
    column, scale = form.keys[key]
    values = [float(value) * scale for value in found if value is not None]
    if not values:
        return GAP
    middle = f"{mean(values):,.{column.digits}f}"
    if len(values) == 1 or key in COSTS:
        return middle
    return f"{middle} ± {(max(values) - min(values)) / 2:.{column.digits}f}"


def _tex(text: str) -> str:
    for plain, tex in (
        ("±", r"$\pm$"), ("→", r"$\to$"), ("↓", r"$\downarrow$"), ("↑", r"$\uparrow$"),
        ("–", "--"), ("%", r"\%"), ("&", r"\&"), ("_", r"\_"),
    ):  # fmt: skip
        text = text.replace(plain, tex)
    return text


def _by(rows: Sequence[Row], key: Callable[[Row], str]) -> dict[str, list[Row]]:
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups

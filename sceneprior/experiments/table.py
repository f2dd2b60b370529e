"""The table of a comparison, as Markdown, CSV and LaTeX, from the scores of its runs."""

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Any

from sceneprior.evaluation.metric import ARROWS, TableColumn
from sceneprior.evaluation.registry import DECODED, METRICS
from sceneprior.files import write_whole

REFERENCES = {
    "Independent objects, as boxes": "independent",
    "Independent objects, with meshes": "independent_meshes",
    "Shuffled furniture, as boxes": "shuffled",
    "Real training rooms": "train_rooms",
}
"""Rows that need no training: (title, where a result keeps their values)."""
GAP = "–"


@dataclass(frozen=True)
class Row:
    """Rooms of one run: of which kind, by which method, their scores and what training it took."""

    rooms: str
    group: str
    title: str
    latents: str
    """What their latents are drawn from."""
    seed: int
    scores: dict[str, Any]
    costs: dict[str, int | float | None]


COSTS = {
    "steps": (TableColumn("steps", 0), 1.0),
    "cpu_s": (TableColumn("CPU min", 1), 1 / 60),
    "parameters": (TableColumn("parameters (M)", 2), 1e-6),
}
"""Columns of what training took, and the factor from the journal's units."""
COLUMNS = {
    **{m.key: (replace(m.column, title=m.column.title + ARROWS[m.direction]), 1.0)
       for m in (*METRICS, *DECODED) if m.column},
    **COSTS,
}  # fmt: skip
CAPTION = (
    "; ".join(column.note for column, _ in COLUMNS.values() if column.note)
    + ". A value of several seeds is their mean ± half their range."
)


def write_tables(rows: Sequence[Row], out: Path) -> None:
    """Write `table.md`, `table.csv` (a line a run) and `table.tex` into a folder."""
    write_whole(out / "table.md", markdown(rows).encode())
    write_whole(out / "table.csv", as_csv(rows).encode())
    write_whole(out / "table.tex", latex(rows).encode())


def markdown(rows: Sequence[Row]) -> str:
    """A table for each kind of rooms, methods under the headings of their groups."""
    parts = []
    for rooms, own in _by(rows, lambda row: row.rooms).items():
        columns = _columns(own)
        lines = [f"### {rooms}", "", _say(own), ""]
        titles = " | ".join(COLUMNS[key][0].title for key in columns)
        lines.append(f"| method | latents | {titles} |")
        lines.append("| --- | --- |" + " ---: |" * len(columns))
        for cells in _body(own, columns):
            if len(cells) == 1:
                lines.append(f"| *{cells[0]}* |" + " |" * (len(columns) + 1))
            else:
                lines.append("| " + " | ".join(cells) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join([*parts, CAPTION]) + "\n"


def latex(rows: Sequence[Row]) -> str:
    """The same for `booktabs`."""
    parts = []
    for rooms, own in _by(rows, lambda row: row.rooms).items():
        columns = _columns(own)
        lines = [
            f"% {rooms}: {_say(own)}",
            r"\begin{tabular}{ll" + "r" * len(columns) + "}",
            r"\toprule",
            " & ".join(["method", "latents", *(_tex(COLUMNS[key][0].title) for key in columns)])
            + r" \\",
        ]
        for first, *cells in ([_tex(cell) for cell in line] for line in _body(own, columns)):
            if cells:
                lines.append(" & ".join([first, *cells]) + r" \\")
            else:
                width = len(columns) + 2
                lines.append(rf"\midrule \multicolumn{{{width}}}{{l}}{{\emph{{{first}}}}} \\")
        parts.append("\n".join([*lines, r"\bottomrule", r"\end{tabular}"]))
    return "\n\n".join([*parts, "% " + _tex(CAPTION)]) + "\n"


def as_csv(rows: Sequence[Row]) -> str:
    """A line a run and distribution of latents, numbers in full."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["rooms", "group", "method", "latents", "seed", *COLUMNS])
    for row in rows:
        values = [_value(row, key) for key in COLUMNS]
        told = ["" if value is None else repr(value) for value in values]
        writer.writerow([row.rooms, row.group, row.title, row.latents, row.seed, *told])
    return text.getvalue()


def _columns(rows: Sequence[Row]) -> list[str]:
    return [key for key in COLUMNS if any(_value(row, key) is not None for row in rows)]


def _body(rows: Sequence[Row], columns: Sequence[str]) -> list[list[str]]:
    """The cells of each line; the line of a group's own heading has one cell."""
    lines = [["reference"]]
    for title, name in REFERENCES.items():
        values = rows[0].scores.get(name, {})
        lines.append([title, GAP, *(_cell([values.get(key)], key) for key in columns)])
    for group, members in _by(rows, lambda row: row.group).items():
        lines.append([group])
        for runs in _by(members, lambda row: f"{row.title}: {row.latents}").values():
            cells = (_cell([_value(row, key) for row in runs], key) for key in columns)
            lines.append([runs[0].title, runs[0].latents, *cells])
    return lines


def _value(row: Row, key: str) -> int | float | None:
    return (row.costs if key in COSTS else row.scores).get(key)


def _cell(found: Sequence[int | float | None], key: str) -> str:
    column, scale = COLUMNS[key]
    values = [float(value) * scale for value in found if value is not None]
    if not values:
        return GAP
    middle = f"{mean(values):,.{column.digits}f}"
    if len(values) == 1 or key in COSTS:
        return middle
    return f"{middle} ± {(max(values) - min(values)) / 2:.{column.digits}f}"


def _say(rows: Sequence[Row]) -> str:
    protocol = rows[0].scores["protocol"]
    seeds = sorted({row.seed for row in rows})
    return (
        f"{protocol['n_generated']} generated rooms a run against {protocol['n_test']} test rooms "
        f"of {protocol['shards']}; {protocol['n_train_rooms']} real training rooms; "
        f"seeds {', '.join(map(str, seeds))}."
    )


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

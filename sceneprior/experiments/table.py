"""Scores of many runs in; one table as Markdown, CSV and LaTeX out."""

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

from sceneprior.files import write_whole

REFERENCES = {
    "Independent objects, as boxes": "independent",
    "Independent objects, with meshes": "independent_meshes",
    "Real training rooms": "train_rooms",
}
"""Rows that need no training: (title, where a result keeps their figures)."""
GAP = "–"


@dataclass(frozen=True)
class Row:
    """One run: which rooms, which method, its scores and what training it took."""

    rooms: str
    group: str
    title: str
    seed: int
    scores: dict[str, Any]
    costs: dict[str, float | None]


@dataclass(frozen=True)
class Column:
    """A figure of the table."""

    title: str
    key: str
    digits: int
    cost: bool = False
    scale: float = 1.0


COLUMNS = (
    Column("FID ↓", "fid", 1),
    Column("FD ↓", "fd_effnet_lite0", 1),
    Column("gap closed ↑", "gap_closed_effnet_lite0_meshes", 2),
    Column("FD, boxes ↓", "fd_effnet_lite0_boxes", 1),
    Column("gap closed, boxes ↑", "gap_closed_effnet_lite0_boxes", 2),
    Column("recall ↑", "recall_effnet_lite0", 2),
    Column("SCA → 0.5", "sca_effnet_lite0", 2),
    Column("category KL ↓", "category_kl", 3),
    Column("objects", "mean_objects", 2),
    Column("type ↑", "type_share", 2),
    Column("overlaps ↓", "overlap_pairs", 2),
    Column("nearest training room (m)", "nearest_training_m", 2),
    Column("train box IoU ↑", "box_iou_3d", 2),
    Column("steps", "steps", 0, cost=True),
    Column("CPU min", "cpu_s", 1, cost=True, scale=1 / 60),
    Column("parameters (M)", "parameters", 2, cost=True, scale=1e-6),
)
CAPTION = (
    "FD: Frechet distance of EfficientNet-Lite0 features, which is not FID; gap closed: share of "
    "the way from independent objects with meshes to real training rooms, in FD; boxes: the same, "
    "all rooms drawn as boxes, so that layouts alone count; recall: share of test rooms that lie "
    "among the pictures of the row; SCA: accuracy of a classifier that tells generated from test "
    "rooms; type: rooms that hold the furniture their type needs; overlaps: intersecting pairs a "
    "room; nearest training room: how far, on average; near 0 a method has learnt them by heart; "
    "train box IoU: decoded training rooms against the truth. A figure of several seeds is their "
    "mean ± half their range."
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
        lines.append("| method | " + " | ".join(column.title for column in columns) + " |")
        lines.append("| --- |" + " ---: |" * len(columns))
        for group, cells in _body(own, columns):
            if len(cells) == 1:
                lines.append(f"| *{group}* |" + " |" * len(columns))
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
            r"\begin{tabular}{l" + "r" * len(columns) + "}",
            r"\toprule",
            " & ".join(["method", *(_tex(column.title) for column in columns)]) + r" \\",
        ]
        for group, cells in _body(own, columns):
            if len(cells) == 1:
                lines.append(
                    rf"\midrule \multicolumn{{{len(columns) + 1}}}{{l}}"
                    rf"{{\emph{{{_tex(group)}}}}} \\"
                )
            else:
                lines.append(" & ".join(_tex(cell) for cell in cells) + r" \\")
        parts.append("\n".join([*lines, r"\bottomrule", r"\end{tabular}"]))
    return "\n\n".join([*parts, "% " + _tex(CAPTION)]) + "\n"


def as_csv(rows: Sequence[Row]) -> str:
    """A line a run, figures in full."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    keys = [column.key for column in COLUMNS]
    writer.writerow(["rooms", "group", "method", "seed", *keys])
    for row in rows:
        values = [row.costs.get(key) if key in row.costs else row.scores.get(key) for key in keys]
        told = ["" if value is None else repr(value) for value in values]
        writer.writerow([row.rooms, row.group, row.title, row.seed, *told])
    return text.getvalue()


def _columns(rows: Sequence[Row]) -> list[Column]:
    return [column for column in COLUMNS if any(_value(row, column) is not None for row in rows)]


def _body(rows: Sequence[Row], columns: Sequence[Column]) -> list[tuple[str, list[str]]]:
    """(group, cells) of each line; the line of a group's own heading has one cell."""
    lines: list[tuple[str, list[str]]] = [("reference", ["reference"])]
    for title, column in REFERENCES.items():
        lines.append(("reference", [title, *(_reference(rows[0], column, c) for c in columns)]))
    for group, members in _by(rows, lambda row: row.group).items():
        lines.append((group, [group]))
        for title, runs in _by(members, lambda row: row.title).items():
            lines.append((group, [title, *(_cell(runs, column) for column in columns)]))
    return lines


def _reference(row: Row, where: str, column: Column) -> str:
    value = None if column.cost else row.scores.get(where, {}).get(column.key)
    return GAP if value is None else f"{value * column.scale:.{column.digits}f}"


def _cell(runs: Sequence[Row], column: Column) -> str:
    values = [value for run in runs if (value := _value(run, column)) is not None]
    if not values:
        return GAP
    middle = f"{mean(values):,.{column.digits}f}"
    if len(values) == 1 or column.cost:
        return middle
    return f"{middle} ± {(max(values) - min(values)) / 2:.{column.digits}f}"


def _value(row: Row, column: Column) -> float | None:
    value = (row.costs if column.cost else row.scores).get(column.key)
    return None if value is None else float(value) * column.scale


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

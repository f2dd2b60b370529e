"""The tables of a comparison, as Markdown and CSV, from the scores of its runs."""

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Any

from sceneprior.apps.experiments.makers import LIFTED, PAPER
from sceneprior.core.files import write_whole
from sceneprior.evaluation.metric import ARROWS, Direction, TableColumn
from sceneprior.evaluation.registry import DECODED, METRICS

GAP = "–"
COSTS = {
    "steps": TableColumn("steps", 0),
    "cpu_s": TableColumn("CPU min", 1),
    "parameters": TableColumn("parameters (M)", 2),
}
"""Columns of the costs of training."""
FACTORS = {"cpu_s": 1 / 60, "parameters": 1e-6}
"""Factors from the units of costs to those of the table."""


@dataclass(frozen=True)
class Row:
    """Result of one run."""

    rooms: str
    group: str
    title: str
    variant: str
    """Value that distinguishes the row from other rows of its run; `Form.variant` is the heading of
    its column."""
    seed: int | None
    """Seed of training; None for existing scenes."""
    scores: dict[str, Any]
    """Values by key of a result, with its protocol, reference rows and the costs of training."""
    made_by: str
    """Name of the method in captions (`Maker.said`)."""
    rank: int = 0
    """Position of the row's group: groups are sorted by rank."""


@dataclass(frozen=True)
class Form:
    """Columns and captions of the tables of one kind of comparison."""

    columns: dict[str, TableColumn]
    """Columns by key of the scores; the columns of `COSTS` follow."""
    references: dict[str, str]
    """Key of the values in a result, by title, for each reference row, which needs no training."""
    variant: str
    """Heading of the second column."""
    say: Callable[[dict[str, Any]], str]
    """Builds the caption's sentence on the evaluation from one of the results."""


def write_tables(rows: Sequence[Row], out: Path, form: Form) -> None:
    """Write `table.md` and `table.csv` (one line per run) into a folder."""
    write_whole(out / "table.md", markdown(rows, form).encode())
    write_whole(out / "table.csv", as_csv(rows, form).encode())


def markdown(rows: Sequence[Row], form: Form) -> str:
    """A Markdown table for each kind of rooms, with methods under the headings of their groups."""
    parts = []
    for rooms, own in _by(rows, lambda row: row.rooms).items():
        columns = {
            key: column
            for key, column in (form.columns | COSTS).items()
            if any(row.scores.get(key) is not None for row in own)
        }
        titles = [column.title for column in columns.values()]
        lines = [f"### {rooms}", "", _caption(own, form), ""]
        lines.append(_line(["method", form.variant, *titles]))
        lines.append("| --- | --- |" + " ---: |" * len(columns))
        lines += [_line(cells) for cells in _body(own, columns, form)]
        parts.append("\n".join(lines))
    notes = [column.note for column in form.columns.values() if column.note]
    seeds = "A value of several seeds is their mean ± half their range."
    return "\n\n".join([*parts, f"{'; '.join(notes)}. {seeds}"]) + "\n"


def as_csv(rows: Sequence[Row], form: Form) -> str:
    """One line per run and variant, with unrounded numbers."""
    keys = [*form.columns, *COSTS]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["rooms", "group", "method", "made by", form.variant, "seed", *keys])
    for row in rows:
        named = [row.rooms, row.group, row.title, row.made_by, row.variant, row.seed]
        writer.writerow([*named, *(row.scores.get(key) for key in keys)])
    return text.getvalue()


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _body(rows: Sequence[Row], columns: dict[str, TableColumn], form: Form) -> list[list[str]]:
    """The cells of each line, including the headings of groups."""

    def heading(group: str) -> list[str]:
        return [f"*{group}*", *[""] * (len(columns) + 1)]

    lines = [heading("reference")]
    for title, name in form.references.items():
        values = rows[0].scores.get(name, {})
        cells = [_cell([values.get(key)], key, of, values) for key, of in columns.items()]
        lines.append([title, GAP, *cells])
    ranked = sorted(rows, key=lambda row: row.rank)
    for group, members in _by(ranked, lambda row: row.group).items():
        lines.append(heading(group))
        for runs in _by(members, lambda row: f"{row.title}: {row.variant}").values():
            values = runs[0].scores if len(runs) == 1 else {}
            cells = [
                _cell([row.scores.get(key) for row in runs], key, of, values)
                for key, of in columns.items()
            ]
            lines.append([runs[0].title, runs[0].variant, *cells])
    return lines


def _cell(
    found: Sequence[int | float | None], key: str, column: TableColumn, scores: dict[str, Any]
) -> str:
    """The mean of a value over seeds, with half its range, or with the interval of `scores`."""
    values = [float(value) * FACTORS.get(key, 1.0) for value in found if value is not None]
    if not values:
        return GAP
    middle = f"{mean(values):,.{column.digits}f}"
    if interval := scores.get("intervals", {}).get(key):
        low, high = (f"{end:,.{column.digits}f}" for end in interval)
        return f"{middle} [{low}, {high}]"
    if len(values) == 1 or key in COSTS:
        return middle
    return f"{middle} ± {(max(values) - min(values)) / 2:.{column.digits}f}"


def _by(rows: Sequence[Row], key: Callable[[Row], str]) -> dict[str, list[Row]]:
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


def _arrowed(column: TableColumn, direction: Direction) -> TableColumn:
    """The column with an arrow in its title for the better direction."""
    return replace(column, title=column.title + ARROWS[direction])


def _caption(rows: Sequence[Row], form: Form) -> str:
    """The sentences above a table: the maker of each row, the evaluation, and the seeds."""
    titles: dict[str, list[str]] = {PAPER.said: [], LIFTED: []}
    for row in rows:
        named = titles.setdefault(row.made_by, [])
        if row.title not in named:
            named.append(row.title)
    parts = (
        f"of {said}: " + (", ".join(f"'{title}'" for title in named) or "none")
        for said, named in titles.items()
    )
    seeds = sorted({row.seed for row in rows if row.seed is not None})
    told = ", ".join(map(str, seeds)) or "none"
    return f"Rows {'; '.join(parts)}. {form.say(rows[0].scores)}; seeds {told}."


def _of_new_rooms(scores: dict[str, Any]) -> str:
    protocol = scores["protocol"]
    return (
        f"{protocol['n_generated']} generated rooms per run against {protocol['n_test']} test "
        f"rooms of {protocol['shards']}; {protocol['n_train_rooms']} real training rooms"
    )


def _of_views(scores: dict[str, Any]) -> str:
    protocol = scores["protocol"]
    surfaces, known = scores["with_surface"], protocol["known_model_share"]
    objects = f"{scores['objects']} objects"
    if surfaces < scores["objects"]:
        objects += f" ({surfaces} of them with a known surface)"
    told = [
        f"{scores['images']} views of {scores['rooms']} test rooms of "
        f"{Path(protocol['shards']).name}, {objects}",
        "masks, classes, 2D boxes and cameras are given to every method",
        "boxes are upright and along the room's axes, in the truth and in every answer",
    ]
    if known is not None:
        told.insert(
            1, f"{known:.0%} of the objects have a CAD model that also occurs in training rooms"
        )
    return "; ".join(told)


NEW_ROOMS = Form(
    columns={m.key: _arrowed(m.column, m.direction) for m in (*METRICS, *DECODED) if m.column},
    references={
        "Independent objects, as boxes": "independent",
        "Independent objects, with meshes": "independent_meshes",
        "Shuffled furniture, as boxes": "shuffled",
        "Real training rooms": "train_rooms",
    },
    variant="latents",
    say=_of_new_rooms,
)
CD = TableColumn("CD (m)", 3, "CD: mean distance to the other surface, both ways added")
SECONDS = TableColumn(
    "s per image",
    3,
    "s per image: CPU seconds, all images together; [from, to]: 95% interval over rooms, all views "
    "of a room together",
)
VIEWS = Form(
    columns={
        "box_iou_3d": _arrowed(TableColumn("3D box IoU", 3), "higher"),
        "chamfer_l2_m": _arrowed(CD, "lower"),
        "f_score": _arrowed(TableColumn("F at 5 cm", 3), "higher"),
        "seconds": _arrowed(SECONDS, "lower"),
    },
    references={
        "Nearest training room by masks": "nearest_room",
        "Random training room": "random_room",
    },
    variant="shapes",
    say=_of_views,
)

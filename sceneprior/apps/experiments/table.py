"""The tables of a comparison, as Markdown and CSV, from the result files of its runs."""

import csv
import io
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

from pydantic import BaseModel, Field

from sceneprior.apps.config import load_any_run
from sceneprior.apps.experiments.commands import read_journal, read_result
from sceneprior.apps.experiments.comparison import (
    LIFTED,
    PAPER,
    Comparison,
    Run,
    Variant,
    ViewComparison,
    variants_of,
)
from sceneprior.core.files import write_whole
from sceneprior.evaluation.metric import ARROWS, EMPTY, TableColumn
from sceneprior.evaluation.metrics import DECODED, METRICS
from sceneprior.evaluation.score_table import Scores
from sceneprior.evaluation.view_scores import ViewScores
from sceneprior.lifted.trained import SAMPLER
from sceneprior.paper.sampling import marked
from sceneprior.training.method import read_checkpoint

Result = dict[str, Any]
"""Values by key of a result, with its protocol, reference rows and the costs of training."""

GAP, FEW = "–", 50
"""An unknown value, and the number of test rooms below which a table warns."""
DECODED_ROOMS = "of training rooms, decoded"
GROUPS = {
    "paper": "rooms of new latents (paper)",
    SAMPLER: "rooms of the lifted method's sampler, object by object",
    "its own": "rooms of methods trained on {}",
    DECODED_ROOMS: "training rooms, decoded: nothing is new",
    "kernel": "copies: rooms near training rooms",
}
"""Group headings of a table of new rooms, in order, by `protocol.latents` of a result. `{}` stands
for the method's supervision."""
SHAPES = {"fit": "as found", "fit_cad": "CAD models"}
"""Rows of an `eval-svr` result that the table shows, with their values in the column `shapes`."""
COSTS = {
    "steps": TableColumn("steps", 0),
    "cpu_s": TableColumn("CPU min", 1),
    "parameters": TableColumn("parameters (M)", 2),
}
"""Columns of the costs of training."""
FACTORS = {"cpu_s": 1 / 60, "parameters": 1e-6}
"""Factors from the units of costs to those of the table."""


class _RoomsProtocol(BaseModel):
    latents: str = Field(pattern=f"^({'|'.join(map(re.escape, GROUPS))})(,|$)")
    shards: str
    n_generated: int
    n_test: int
    n_train_rooms: int


class _Rooms(Scores):
    protocol: _RoomsProtocol  # type: ignore[assignment]


class Row(NamedTuple):
    """Result of one variant of a run."""

    rooms: str
    seed: int
    """Seed of training."""
    title: str
    made_by: str
    """Name of the method in captions (`Variant.made_by`)."""
    variant: str
    """Value of the second column, which distinguishes the row from other rows of its run."""
    scores: Result
    group: str
    rank: int
    """Position of the row's group."""


class Form(NamedTuple):
    """Columns and captions of the tables of one task."""

    columns: dict[str, TableColumn]
    """Columns by key of the scores; the columns of `COSTS` follow."""
    references: dict[str, str]
    """Key of the values in a result, by title, for each reference row, which needs no training."""
    variant: str
    """Heading of the second column."""
    say: Callable[[Result], str]
    """Builds the caption's sentence on the evaluation from one of the results."""


def write_tables(comparison: Comparison, runs: Sequence[Run], out: Path) -> None:
    """Write `table.md` and `table.csv` (one line per run and variant) of evaluated runs."""
    rows = [row for run in runs for row in rows_of(comparison, run)]
    form = VIEWS if isinstance(comparison, ViewComparison) else NEW_ROOMS
    write_whole(out / "table.md", markdown(rows, form))
    write_whole(out / "table.csv", as_csv(rows, form))


# -- From results to rows --------------------------------------------------------------------------


def rows_of(comparison: Comparison, run: Run) -> list[Row]:
    """The rows of an evaluated run; the first row includes the costs of training."""
    of_task, schema = (
        (_rows_of_views, ViewScores)
        if isinstance(comparison, ViewComparison)
        else (_rows_of_rooms, _Rooms)
    )
    found = {of: read_result(of.result, schema) for of in variants_of(comparison, run)}
    title = comparison.rooms[run.rooms].title
    rows = [
        Row(title, run.seed, of.title, of.made_by, variant, scores, group, rank)
        for of, variant, scores, group, rank in of_task(found, run.run_config.learns_from)
    ]
    rows[0].scores.update(costs_of(run))
    return rows


def _rows_of_rooms(
    found: dict[Variant, Result], learns_from: str
) -> Iterator[tuple[Variant, str, Result, str, int]]:
    """A row for each distribution of latents, and one for decoded training rooms if there are
    any."""
    # A result names the distribution of its rooms, with the mark of the version that wrote it.
    rows = [
        (variant, scores["protocol"]["latents"].split(",")[0], scores)
        for variant, scores in found.items()
    ]
    first, last = rows[0][2], rows[-1][0]
    rows = [(variant, origin, _of_set(scores, "generated")) for variant, origin, scores in rows]
    if first.get("decoded_rooms"):
        # The last variant decodes latents; a sampler, which decodes no room, would come first.
        rows.append((last, DECODED_ROOMS, _of_set(first, "decoded_rooms")))
    for variant, origin, scores in rows:
        group = GROUPS[origin].format(learns_from)
        yield variant, marked(origin), scores, group, list(GROUPS).index(origin)


def _of_set(scores: Result, name: str) -> Result:
    """The values of a set of rooms with their intervals; of generated rooms, the whole result."""
    found = scores.get(name, {})
    if name == "generated":
        sets = [key for key in NEW_ROOMS.references.values() if key in scores]
        found = scores | {key: _of_set(scores, key) for key in sets}
    intervals = scores.get("intervals", {}).get(name, {})
    return {**found, "intervals": intervals, "protocol": scores["protocol"]}


def _rows_of_views(
    found: dict[Variant, Result], learns_from: str
) -> Iterator[tuple[Variant, str, Result, str, int]]:
    """A row for each fit, and another one if its objects were also replaced by CAD models."""
    for variant, result in found.items():
        of: dict[str, Result] = {
            name: {**row["summary"], "intervals": row["intervals"]}
            for name, row in result["rows"].items()
        }
        of["fit"]["seconds"] = result["cpu_seconds_an_image"]
        references = {name: of[name] for name in VIEWS.references.values()}
        for name, shapes in SHAPES.items():
            if name in of:
                scores = {**of[name], **references, "protocol": result["protocol"]}
                yield variant, shapes, scores, f"trained on {learns_from}", 0


def costs_of(run: Run) -> dict[str, int | float | None]:
    """Costs of training; CPU seconds are None if training was killed or started by hand."""
    steps = 0
    for final in (run.folder / "run").glob("*/final.ckpt"):
        saved = read_checkpoint(final)
        # Lightning counts updates; a GAN's two networks make two updates per batch.
        steps += saved["global_step"] // len(saved["optimizer_states"])
    networks = load_any_run(run.folder / "run").prior
    return {
        "cpu_s": read_journal(run.folder).get("fit", {}).get("cpu_s"),
        "steps": steps,
        "parameters": sum(item.numel() for item in networks.parameters()),
    }


# -- From rows to tables ---------------------------------------------------------------------------


def markdown(rows: Sequence[Row], form: Form) -> str:
    """A Markdown table for each kind of rooms, with methods under the headings of their groups."""
    tables = [
        f"### {own[0].rooms}\n\n{_warnings(own)}{_caption(own, form)}\n\n"
        + "\n".join(f"| {' | '.join(cells)} |" for cells in _lines(own, form))
        for own in _by(rows, "rooms")
    ]
    notes = "; ".join(column.note for column in form.columns.values() if column.note)
    seeds = "A value of several seeds is their mean ± half their range."
    return "\n\n".join([*tables, f"{notes}. {seeds}"]) + "\n"


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


def _lines(rows: Sequence[Row], form: Form) -> Iterator[list[str]]:
    """The cells of each line of a table, including its head and the headings of groups."""
    columns = {
        key: column
        for key, column in (form.columns | COSTS).items()
        if any(row.scores.get(key) is not None for row in rows)
    }

    def line(title: str, second: str, found: Sequence[Result]) -> list[str]:
        return [title, second, *(_cell(found, key, of) for key, of in columns.items())]

    yield ["method", form.variant, *(column.title for column in columns.values())]
    yield ["---", "---", *["---:"] * len(columns)]
    empty = [""] * (len(columns) + 1)
    yield ["*reference*", *empty]
    for title, name in form.references.items():
        yield line(title, GAP, [rows[0].scores.get(name, {})])
    for members in _by(sorted(rows, key=lambda row: row.rank), "group"):
        yield [f"*{members[0].group}*", *empty]
        for runs in _by(members, "title", "variant"):
            yield line(runs[0].title, runs[0].variant, [row.scores for row in runs])


def _cell(found: Sequence[Result], key: str, column: TableColumn) -> str:
    """The mean of a value over seeds, with half its range, or one value with its interval."""
    known = [scores[key] for scores in found if scores.get(key) is not None]
    values = [float(value) * FACTORS.get(key, 1.0) for value in known]
    if not values:
        return GAP
    middle = f"{mean(values):,.{column.digits}f}"
    if len(found) == 1 and (interval := found[0].get("intervals", {}).get(key)):
        low, high = (f"{end:,.{column.digits}f}" for end in interval)
        return f"{middle} [{low}, {high}]"
    if len(values) == 1 or key in COSTS:
        return middle
    return f"{middle} ± {(max(values) - min(values)) / 2:.{column.digits}f}"


def _by(rows: Sequence[Row], *names: str) -> list[list[Row]]:
    """Rows with equal values of these fields, in the order of their first rows."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(getattr(row, name) for name in names), []).append(row)
    return list(groups.values())


def _warnings(rows: Sequence[Row]) -> str:
    """Paragraphs on what makes a table's values uncertain or meaningless."""
    count, found = rows[0].scores["protocol"].get("n_test", FEW), dict[str, None]()
    if count < FEW:
        found[f"with {count} test rooms, rows whose intervals overlap cannot be told apart"] = None
    for row in rows:
        if EMPTY in (note := row.scores.get("note", "")):
            found[f"'{row.title}', {row.variant}: {note.partition(':')[0]}"] = None
    return "".join(f"**Warning:** {each}.\n\n" for each in found)


def _caption(rows: Sequence[Row], form: Form) -> str:
    """The sentences above a table: the method of each row, the evaluation, and the seeds."""
    titles: dict[str, dict[str, None]] = {PAPER: {}, LIFTED: {}}
    for row in rows:
        titles.setdefault(row.made_by, {})[f"'{row.title}'"] = None
    parts = (f"of {said}: {', '.join(named) or 'none'}" for said, named in titles.items())
    told = ", ".join(map(str, sorted({row.seed for row in rows})))
    return f"Rows {'; '.join(parts)}. {form.say(rows[0].scores)}; seeds {told}."


def _say_rooms(scores: Result) -> str:
    protocol = scores["protocol"]
    return (
        f"{protocol['n_generated']} generated rooms per run against {protocol['n_test']} test "
        f"rooms of {protocol['shards']}; {protocol['n_train_rooms']} real training rooms"
    )


def _say_views(scores: Result) -> str:
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
    columns={
        metric.key: replace(metric.column, title=metric.column.title + ARROWS[metric.direction])
        for metric in (*METRICS, *DECODED)
        if metric.column
    },
    references={
        "Independent objects, as boxes": "independent",
        "Independent objects, with meshes": "independent_meshes",
        "Shuffled furniture, as boxes": "shuffled",
        "Real training rooms": "train_rooms",
    },
    variant="latents",
    say=_say_rooms,
)
_CD = "CD: mean distance to the other surface, both ways added"
_SECONDS = (
    "s per image: CPU seconds, all images together; [from, to]: 95% interval over rooms, all views "
    "of a room together"
)
VIEWS = Form(
    columns={
        "box_iou_3d": TableColumn("3D box IoU ↑", 3),
        "chamfer_l2_m": TableColumn("CD (m) ↓", 3, _CD),
        "f_score": TableColumn("F at 5 cm ↑", 3),
        "seconds": TableColumn("s per image ↓", 3, _SECONDS),
    },
    references={
        "Nearest training room by masks": "nearest_room",
        "Random training room": "random_room",
    },
    variant="shapes",
    say=_say_views,
)

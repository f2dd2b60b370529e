"""Rows of tables, from result files; the columns and captions of the tables of each task."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, Field

from sceneprior.apps.config import load_any_run
from sceneprior.apps.experiments.commands import read_journal, read_result
from sceneprior.apps.experiments.comparison import (
    Comparison,
    Run,
    Variant,
    ViewComparison,
    variants_of,
)
from sceneprior.evaluation.metric import EMPTY, TableColumn
from sceneprior.evaluation.metrics import DECODED, METRICS, USE
from sceneprior.evaluation.score_table import Scores
from sceneprior.evaluation.view_scores import ViewScores
from sceneprior.lifted.trained import SAMPLER
from sceneprior.paper.sampling import marked
from sceneprior.training.method import read_checkpoint

Result = dict[str, Any]
"""Values by key of a result, with its protocol, reference rows and the costs of training."""

FEW = 50
"""Number of test rooms below which a table warns."""
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
REFERENCE = "reference"
"""Heading of the rows that need no training."""
UNRANKED = (REFERENCE, GROUPS[DECODED_ROOMS], GROUPS["kernel"])
"""Groups that take no part in the ranking."""
SHAPES = {"fit": "as found", "fit_cad": "CAD models"}
"""Rows of an `eval-svr` result that the table shows, with their values in the column `shapes`."""
OF_SCENES = {metric.key for metric in (*METRICS, *USE) if metric.network is None}
"""Metrics that read classes, boxes and meshes instead of pictures."""
COSTS = {
    "steps": TableColumn("steps", 0),
    "cpu_s": TableColumn("CPU min", 1),
    "parameters": TableColumn("parameters (M)", 2),
}
"""Columns of the costs of training."""


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
    first, last = rows[0][2], [variant for variant, *_ in rows if not variant.cad][-1]
    rows = [(variant, origin, of_set(scores, "generated")) for variant, origin, scores in rows]
    for variant, _, scores in rows:
        if variant.cad:  # CAD models change pictures; boxes and layouts are those of the row above
            for values in (scores, scores["intervals"]):
                for key in OF_SCENES & values.keys():
                    del values[key]
    if first.get("decoded_rooms"):
        # The last variant decodes latents; a sampler, which decodes no room, would come first.
        rows.append((last, DECODED_ROOMS, of_set(first, "decoded_rooms")))
    for variant, origin, scores in rows:
        group = GROUPS[origin].format(learns_from)
        yield variant, marked(origin), scores, group, list(GROUPS).index(origin)


def of_set(scores: Result, name: str) -> Result:
    """The values of a set of rooms with their intervals; of generated rooms, the whole result,
    without the metrics that mean nothing because the rooms are empty."""
    found = scores.get(name, {})
    if name == "test":
        found = {key[:-5]: value for key, value in scores.items() if key.endswith("_test")}
    elif name == "generated":
        sets = [*NEW_ROOMS.references.values()]
        found = scores | {key: of_set(scores, key) for key in sets if key in (*scores, "test")}
        if EMPTY in scores.get("note", ""):
            found |= {
                key: None for key in NEW_ROOMS.columns.keys() & found.keys() - {"mean_objects"}
            }
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


def form_of(comparison: Comparison) -> Form:
    """Columns and captions of the tables of a comparison."""
    return VIEWS if isinstance(comparison, ViewComparison) else NEW_ROOMS


# -- Columns and captions --------------------------------------------------------------------------


def _say_rooms(scores: Result) -> str:
    protocol = scores["protocol"]
    generated = f"{protocol['n_generated']} generated rooms per run"
    if "shards" not in protocol:
        return f"{generated}, compared with no real rooms"
    return f"{generated} against {protocol['n_test']} test rooms of {protocol['shards']}" + (
        f"; {count} real training rooms" if (count := protocol.get("n_train_rooms")) else ""
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
        metric.key: replace(metric.column, direction=metric.direction)
        # Metrics of use stand after the first, which sums up the checks of function.
        for metric in (METRICS[0], *USE, *METRICS[1:], *DECODED)
        if metric.column
    },
    references={
        "Independent objects, as boxes": "independent",
        "Independent objects, with meshes": "independent_meshes",
        "Shuffled furniture, as boxes": "shuffled",
        "Shuffled furniture, with meshes": "shuffled_meshes",
        "Real training rooms": "train_rooms",
        "Real test rooms": "test",
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
        "box_iou_3d": TableColumn("3D box IoU", 3, direction="higher"),
        "chamfer_l2_m": TableColumn("CD (m)", 3, _CD, "lower"),
        "f_score": TableColumn("F at 5 cm", 3, direction="higher"),
        "seconds": TableColumn("s per image", 3, _SECONDS, "lower"),
    },
    references={
        "Nearest training room by masks": "nearest_room",
        "Random training room": "random_room",
    },
    variant="shapes",
    say=_say_views,
)

"""An evaluation result: its schema, and its table as rows of text, for pages and printed."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sceneprior.core.checked import checked
from sceneprior.core.files import read_json
from sceneprior.evaluation.metrics import METRICS, USE

FORMAT = "sceneprior-scores"

WIDTH = 150
"""Width in characters of a table written to a file; narrower tables fold intervals."""

COLUMNS = {
    "generated": "generated",
    "decoded_rooms": "decoded training",
    "train_rooms": "real training",
    "shuffled": "shuffled",
    "independent": "independent",
    "test": "real test",
}
"""Headings by set of rooms. The protocol counts the rooms of a set under `n_<set>`; a set without
such a count has no column."""

RELATION_HEADINGS = (
    "an object", "and the nearest", "distance of gaps, m", "real training, m",
    "within 0.3 m", "real test",
)  # fmt: skip


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]


class _Relation(BaseModel):
    of: str
    to: str
    distance_m: Number
    train_m: Number
    near: Number | None
    near_test: Number | None


class Scores(BaseModel):
    """The contents of a result file, as `evaluate_synthesis` describes them.

    The metrics of generated and test rooms are by key, and those of other sets by set and key.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Number | None]
    format: Literal["sceneprior-scores"]
    version: int
    decoded_rooms: dict[str, Number | None] = {}
    train_rooms: dict[str, Number | None] = {}
    shuffled: dict[str, Number | None] = {}
    independent: dict[str, Number | None] = {}
    independent_meshes: dict[str, Number | None] = {}
    shuffled_meshes: dict[str, Number | None] = {}
    intervals: dict[str, dict[str, tuple[Number, Number] | None]]
    relations: list[_Relation] = []
    note: str = ""
    protocol: dict[str, Any]


def read_scores(path: Path, hint: str) -> dict[str, Any]:
    """Read a result file; `hint` says how it is written."""
    found = read_json(path, hint=hint)
    checked(Scores, found, f"{path} holds no scores", hint)
    return found


def score_rows(scores: dict[str, Any]) -> list[tuple[str, ...]]:
    """The table of a result: (title, unit, one cell per column of `headings`).

    A cell holds the value and, on a second line, its interval; a missing value is a dash. A metric
    that the result lacks has no row.
    """
    columns = []
    for name in _sets(scores):
        suffix = "_test" if name == "test" else ""
        values = scores if name in ("generated", "test") else scores.get(name, {})
        columns.append((values, suffix, scores.get("intervals", {}).get(name, {})))
    return [
        (
            metric.title,
            metric.subtitle,
            *(
                _cell(values.get(metric.key + suffix), intervals.get(metric.key))
                for values, suffix, intervals in columns
            ),
        )
        for metric in (*METRICS, *USE)
        if metric.key in scores
    ]


def _cell(value: float | None, interval: list[float] | None) -> str:
    if value is None:
        return "–"
    digits = 3 if abs(value) < 10 else 1
    if interval is None or value == interval[0] == interval[1]:
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f}\n{interval[0]:.{digits}f} to {interval[1]:.{digits}f}"


def relation_rows(scores: dict[str, Any]) -> list[tuple[str, ...]]:
    """Rows of text under `RELATION_HEADINGS`: the pairs of classes whose gaps differ most from
    those in the test rooms."""
    return [
        (
            row["of"], row["to"], f"{row['distance_m']:.2f}", f"{row['train_m']:.2f}",
            *("–" if row[key] is None else f"{row[key]:.2f}" for key in ("near", "near_test")),
        )
        for row in scores.get("relations", [])
    ]  # fmt: skip


def headings(scores: dict[str, Any]) -> list[tuple[str, str]]:
    """(title, number of rooms) of those `COLUMNS` that the result has."""
    protocol = scores.get("protocol", {})
    titles = COLUMNS | {"test": f"real {protocol.get('split', 'test')}"}
    return [(titles[name], f"{protocol[f'n_{name}']} rooms") for name in _sets(scores)]


def _sets(scores: dict[str, Any]) -> list[str]:
    return [name for name in COLUMNS if f"n_{name}" in scores.get("protocol", {})]


def wide_console() -> Console:
    """A console on stdout, at least `WIDTH` wide for a file or a pipe, where rich assumes 80."""
    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, WIDTH)
    return console


def print_scores(scores: dict[str, Any]) -> None:
    """Print the table of a result, and the protocol's main entries below it."""
    console = wide_console()
    split = scores.get("protocol", {}).get("split")
    title = "Rooms for use" if split is None else f"Synthesis against {split} rooms"
    table = Table(title=title, box=box.SIMPLE_HEAD, caption=_caption(scores))
    table.add_column("", overflow="fold")
    for heading, rooms in headings(scores):
        table.add_column(f"{heading}\n{rooms}", justify="right")
    for title, unit, *cells in score_rows(scores):
        lines = (text.split("\n") for text in (f"{title}\n{unit}", *cells))
        table.add_row(
            *(
                Text.assemble(first, *((f"\n{line}", "dim") for line in below))
                for first, *below in lines
            )
        )
    console.print(table)
    if rows := relation_rows(scores):
        pairs = Table(
            *RELATION_HEADINGS, box=box.SIMPLE_HEAD,
            title="Pairs of classes that add most to the distance of relations",
        )  # fmt: skip
        for row in rows:
            pairs.add_row(*row)
        console.print(pairs)


def _caption(scores: dict[str, Any]) -> str:
    protocol = scores.get("protocol", {})
    parts = {
        "latents": protocol.get("latents"),
        "shards": protocol.get("shards"),
        "seed": protocol.get("seed"),
        "renderer": protocol.get("render", {}).get("renderer"),
        "test renders": protocol.get("renders_sha256", {}).get("test", "")[:16],
    }
    if protocol.get("resamples"):
        parts["95% intervals from"] = f"{protocol['resamples']} resamples"
    stated = (f"{name} {value}" for name, value in parts.items() if value not in (None, ""))
    missing: dict[str, list[str]] = {}
    for key, want in protocol.get("left_out", {}).items():
        missing.setdefault(want, []).append(key)
    left_out = [
        f"Not measured without {want}: {', '.join(keys)}." for want, keys in missing.items()
    ]
    return "\n".join(filter(None, (", ".join(stated), *left_out, scores.get("note"))))

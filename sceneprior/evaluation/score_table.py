"""The table of a result: rows of text for pages, and the table in the terminal."""

from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sceneprior.evaluation.registry import METRICS

WIDTH = 110
"""Characters of a table that goes to a file: what fits without folding an interval."""

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("generated", "generated", "n_generated"),
    ("train_rooms", "real training", "n_train_rooms"),
    ("independent", "independent", "n_independent"),
    ("test", "real test", "n_test"),
)
"""(name of the column's intervals, heading, where the protocol counts its rooms)."""


def score_rows(scores: dict[str, Any]) -> list[tuple[str, ...]]:
    """The table of a result: (title, unit, a cell per column of `COLUMNS`).

    A cell is the value and, on a line of its own, its interval. A metric that a column does not
    have is a dash; a key that the result lacks is no row.
    """
    rows = []
    for metric in METRICS:
        if metric.key in scores:
            cells = (_cell(scores, column, metric.key) for column, _, _ in COLUMNS)
            rows.append((metric.title, metric.subtitle, *cells))
    return rows


def headings(scores: dict[str, Any]) -> list[tuple[str, str]]:
    """(what a column holds, how many rooms stand behind it) of each of `COLUMNS`."""
    protocol = scores.get("protocol", {})
    return [(title, f"{protocol.get(count, '?')} rooms") for _, title, count in COLUMNS]


def _cell(scores: dict[str, Any], column: str, key: str) -> str:
    places = {"generated": (scores, key), "test": (scores, f"{key}_test")}
    where, name = places.get(column) or (scores.get(column, {}), key)
    value = where.get(name)
    interval = scores.get("intervals", {}).get(column, {}).get(key)
    if value is None:
        return "–"
    digits = 3 if abs(value) < 10 else 1
    if interval is None or value == interval[0] == interval[1]:
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f}\n{interval[0]:.{digits}f} to {interval[1]:.{digits}f}"


def wide_console() -> Console:
    """stdout; a file or a pipe has no width, for which rich would take 80."""
    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, WIDTH)
    return console


def print_scores(scores: dict[str, Any], console: Console | None = None) -> None:
    """Print the table of a result to stdout, with how many rooms stand behind each column.

    Below the table stand the protocol's main entries: where the rooms come from, seed, renderer,
    and the hash of the test rooms' pictures.
    """
    console = console or wide_console()
    table = Table(
        title="Synthesis against test rooms", box=box.SIMPLE_HEAD, caption=_caption(scores)
    )
    table.add_column("", overflow="fold")
    for heading, rooms in headings(scores):
        table.add_column(f"{heading}\n{rooms}", justify="right")
    for title, unit, *cells in score_rows(scores):
        table.add_row(*(_dim_below_first(text) for text in (f"{title}\n{unit}", *cells)))
    console.print(table)


def _dim_below_first(cell: str) -> Text:
    first, *below = cell.split("\n")
    return Text.assemble(first, *((f"\n{line}", "dim") for line in below))


def _caption(scores: dict[str, Any]) -> str:
    protocol = scores.get("protocol", {})
    parts = {
        "shards": protocol.get("shards"),
        "seed": protocol.get("seed"),
        "renderer": protocol.get("render", {}).get("renderer"),
        "test renders": protocol.get("renders_sha256", {}).get("test", "")[:16],
        "95% intervals from": f"{protocol['resamples']} resamples"
        if protocol.get("resamples")
        else None,
    }
    stated = ", ".join(
        f"{name} {value}" for name, value in parts.items() if value not in (None, "")
    )
    return "\n".join(line for line in (stated, scores.get("note")) if line)

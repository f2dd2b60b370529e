"""The table of a result: rows of text for pages, and the table in the terminal."""

from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sceneprior.evaluation.registry import METRICS

WIDTH = 150
"""Characters of a table that goes to a file: what fits without folding an interval."""

COLUMNS = {
    "generated": "generated",
    "decoded_rooms": "decoded training",
    "train_rooms": "real training",
    "shuffled": "shuffled",
    "independent": "independent",
    "test": "real test",
}
"""Headings by the names of sets of rooms; `n_` and such a name counts its rooms in a protocol, and
a set that it does not count is no column."""


def score_rows(scores: dict[str, Any]) -> list[tuple[str, ...]]:
    """The table of a result: (title, unit, a cell per column of `headings`).

    A cell is the value and, on a line of its own, its interval. A metric that a column does not
    have is a dash; a key that the result lacks is no row.
    """
    return [
        (
            metric.title,
            metric.subtitle,
            *(_cell(scores, name, metric.key) for name in _sets(scores)),
        )
        for metric in METRICS
        if metric.key in scores
    ]


def headings(scores: dict[str, Any]) -> list[tuple[str, str]]:
    """(what a column holds, how many rooms stand behind it) of each of `COLUMNS`."""
    protocol = scores.get("protocol", {})
    titles = COLUMNS | {"test": f"real {protocol.get('split', 'test')}"}
    return [(titles[name], f"{protocol[f'n_{name}']} rooms") for name in _sets(scores)]


def _sets(scores: dict[str, Any]) -> list[str]:
    return [name for name in COLUMNS if f"n_{name}" in scores.get("protocol", {})]


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
    """Print the table of a result, and the protocol's main entries below it."""
    console = console or wide_console()
    table = Table(
        title=f"Synthesis against {scores.get('protocol', {}).get('split', 'test')} rooms",
        box=box.SIMPLE_HEAD,
        caption=_caption(scores),
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

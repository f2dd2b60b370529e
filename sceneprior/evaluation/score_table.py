"""Scores as tables: a result in; rows of text, and a table in the terminal, out."""

from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

WIDTH = 110
"""Characters of a table that goes to a file: what fits without folding an interval."""

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("generated", "generated", "n_generated"),
    ("train_rooms", "real training", "n_train_rooms"),
    ("independent", "independent", "n_independent"),
    ("test", "real test", "n_test"),
)
"""(name of the column's intervals, heading, where the protocol counts its rooms)."""

SCORE_ROWS: tuple[tuple[str, str, str], ...] = (
    ("fid", "FID (Inception)", "lower is closer"),
    (
        "gap_closed_inception",
        "Gap closed, from independent boxes, Inception",
        "0: theirs, 1: as near as real",
    ),
    (
        "gap_closed_inception_meshes",
        "Gap closed, from independent furniture, Inception",
        "0: theirs, 1: as near as real",
    ),
    ("fid_boxes", "FID, all rooms as boxes (Inception)", "lower is closer"),
    (
        "gap_closed_inception_boxes",
        "Gap closed, all rooms as boxes, Inception",
        "0: independent, 1: as near as real",
    ),
    ("kid", "KID (Inception)", "lower is closer"),
    ("precision_inception", "Precision, Inception", "share of rooms"),
    ("recall_inception", "Recall, Inception", "share of test rooms"),
    ("sca", "SCA (AlexNet)", "0.5 is best"),
    ("fd_effnet_lite0", "Frechet distance, EfficientNet-Lite0 (not FID)", "lower is closer"),
    (
        "gap_closed_effnet_lite0",
        "Gap closed, from independent boxes, Lite0",
        "0: theirs, 1: as near as real",
    ),
    (
        "gap_closed_effnet_lite0_meshes",
        "Gap closed, from independent furniture, Lite0",
        "0: theirs, 1: as near as real",
    ),
    (
        "fd_effnet_lite0_boxes",
        "Frechet distance, all rooms as boxes, Lite0 (not FID)",
        "lower is closer",
    ),
    (
        "gap_closed_effnet_lite0_boxes",
        "Gap closed, all rooms as boxes, Lite0",
        "0: independent, 1: as near as real",
    ),
    ("kid_effnet_lite0", "Kernel distance, EfficientNet-Lite0 (not KID)", "lower is closer"),
    ("precision_effnet_lite0", "Precision, EfficientNet-Lite0", "share of rooms"),
    ("recall_effnet_lite0", "Recall, EfficientNet-Lite0", "share of test rooms"),
    ("sca_effnet_lite0", "Classifier accuracy, EfficientNet-Lite0", "0.5 is best"),
    ("category_kl", "Category KL to test rooms", "nats, lower is closer"),
    ("type_share", "Rooms that hold their type's furniture", "share"),
    ("mean_objects", "Objects in a room", "mean"),
    ("overlap_pairs", "Intersecting pairs in a room", "mean"),
    ("overlap_pair_share", "Intersecting pairs among all pairs", "share"),
    ("overlap_volume_m3", "Volume shared by pairs in a room", "mean, cubic metres"),
    ("out_of_bounds_share", "Pieces out of the floor's bounds", "share; known floors alone"),
    ("walkable_share", "Walkable in one piece, between furniture", "share of free floor"),
    (
        "walkable_share_floor",
        "Walkable in one piece, within the floor",
        "share; known floors alone",
    ),
    ("nearest_training_m", "Distance to the nearest training room", "mean, metres"),
    ("near_copy_share", "Near copies of a training room", "share of rooms"),
)
"""(key, title, unit) in the order of the printed tables."""


def score_rows(scores: dict[str, Any]) -> list[tuple[str, ...]]:
    """The table of a result: (title, unit, a cell per column of `COLUMNS`).

    A cell is the figure and, on a line of its own, its interval. A figure that a column does not
    have is a dash; a key that the result lacks is no row.
    """
    rows = []
    for key, title, unit in SCORE_ROWS:
        if key not in scores:
            continue
        cells = []
        for column, _, _ in COLUMNS:
            interval = scores.get("intervals", {}).get(column, {}).get(key)
            cells.append(_cell(score_of(scores, column, key), interval))
        rows.append((title, unit, *cells))
    return rows


def score_of(scores: dict[str, Any], column: str, key: str) -> float | None:
    """Where a result keeps the figure of a column."""
    if column == "generated":
        return scores.get(key)
    if column == "test":
        return scores.get(f"{key}_test")
    found: float | None = scores.get(column, {}).get(key)
    return found


def headings(scores: dict[str, Any]) -> list[tuple[str, str]]:
    """(what a column holds, how many rooms stand behind it) of each of `COLUMNS`."""
    protocol = scores.get("protocol", {})
    return [(title, f"{protocol.get(count, '?')} rooms") for _, title, count in COLUMNS]


def _cell(value: float | None, interval: list[float] | None) -> str:
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

"""Builds furniture from tables of parts: `beds.yaml`, `seats.yaml` and the other YAML files here.

A table is a name and a list of rows. A row is an expression that makes one part or several
(a solid of `solids.py`, or another table), perhaps once for each value of something:

    desk:
    - box(w, 0.04, d, y=h - 0.04)
    - box(0.05, h, 0.05, x, 0, z) for x, z in corners(w/2 - 0.1, d/2 - 0.1)

It may use the piece's width, height and depth `w`, `h`, `d` in metres, the number of its `style`,
all of `VOCABULARY`, and the random draws `uniform`, `random`, `integers` and `books`. A table
that others use names its parameters, as in `door(w, h, x, y, z, handle_x)`. Where a list of rows
is not enough, a table or a row is a mapping of these keys, worked out in this order:

    for:     `x in both(w/4)`: do all that follows once for each
    let:     names for values that several rows use
    parts:   rows
    styles:  styles by name, each with rows of its own; used is number `style`, modulo their count
    last:    rows that come after those of the style

The front of a piece is at +z, and its bottom at y = 0.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from importlib.resources import files
from itertools import product
from types import CodeType
from typing import Any

import numpy as np
import trimesh
import yaml

from data_prep.homes.solids import PARTS, Parts, Vector, box

DEEP_SOFA_M = 1.3
"""A sofa this deep has a chaise: no seat for one row of people is deeper."""

DINING_WIDTH_M = 1.0
"""A table at least this wide is one to eat at; below, one beside a seat."""


def _around(count: int, x: float, z: float) -> list[tuple[float, float]]:
    turns = np.arange(count) * 2 * np.pi / count
    return [(x * np.sin(turn), z * np.cos(turn)) for turn in turns]


VOCABULARY: dict[str, Any] = {
    **PARTS,
    **{each: getattr(np, each) for each in ("arange", "array", "clip", "cos", "linspace", "sin")},
    "pi": np.pi,
    "product": product,
    # The places of what stands left and right, in four corners, or in a ring.
    "both": lambda x: (-x, x),
    "corners": lambda x, z: ((-x, -z), (-x, z), (x, -z), (x, z)),
    "around": _around,
    "DEEP_SOFA_M": DEEP_SOFA_M,
    "DINING_WIDTH_M": DINING_WIDTH_M,
}
"""What the rows of every table may use, beside Python's own `min`, `max`, `round` and so on."""

Names = dict[str, Any]
Rows = str | list[Any] | dict[str, Any]
_KEYS = {"for", "let", "parts", "styles", "last"}


@dataclass(frozen=True)
class Table:
    """One table of parts; `bind` gives its parameters the values of a call."""

    name: str
    bind: Callable[..., Names]
    rows: Rows

    @classmethod
    def parse(cls, heading: str, rows: Rows) -> "Table":
        """A table from its heading, `name` or `name(w, h, t=0.025)`, and its rows."""
        name, _, parameters = heading.rstrip(")").partition("(")
        return cls(name, eval(f"lambda {parameters or 'w, h, d, style'}: locals()"), rows)

    def build(self, names: Names, *values: Any) -> Parts:
        """The parts for these values of the parameters."""
        return list(_parts(self.rows, names | self.bind(*values), self.name))


@cache
def furniture_tables() -> dict[str, Table]:
    """Every table by its name."""
    found: dict[str, Table] = {}
    for file in files("data_prep.homes").iterdir():
        if file.name.endswith(".yaml"):
            tables = [Table.parse(*item) for item in yaml.safe_load(file.read_text()).items()]
            found |= {table.name: table for table in tables}
    return found


def build(
    name: str,
    size_m: Vector,
    style: int,
    rng: np.random.Generator,
    tables: dict[str, Table] | None = None,
) -> Parts:
    """The parts of one piece of furniture, about as large as `size_m`.

    Args:
        tables: The tables it is looked up in; those of this package if None.

    Raises:
        ValueError: a row cannot be worked out; the table and the row are named.
    """
    names = VOCABULARY | {draw: getattr(rng, draw) for draw in ("uniform", "random", "integers")}
    names["books"] = partial(_books, rng)
    for table in (tables or furniture_tables()).values():
        names[table.name] = partial(table.build, names)
    return names[name](*size_m, style)


def _parts(rows: Rows, names: Names, table: str) -> Iterator[trimesh.Trimesh]:
    if isinstance(rows, str):
        yield from _flat(_value(f"[{rows}]", names, table))
    elif isinstance(rows, list):
        for row in rows:
            yield from _parts(row, names, table)
    else:
        if not rows.keys() <= _KEYS:
            raise ValueError(f"Furniture table '{table}' has the key {min(rows.keys() - _KEYS)!r}.")
        variables, _, values = rows.get("for", "_ in [None]").partition(" in ")
        for value in _value(f"[({variables},) for {variables} in ({values})]", names, table):
            own = names | dict(zip(variables.split(", "), value, strict=True))
            for name, expression in rows.get("let", {}).items():
                own[name] = _value(str(expression), own, table)
            yield from _parts(rows.get("parts", []), own, table)
            if "styles" in rows:
                styles = list(rows["styles"].values())
                yield from _parts(styles[own["style"] % len(styles)], own, table)
            yield from _parts(rows.get("last", []), own, table)


def _flat(parts: trimesh.Trimesh | list[Any]) -> Iterator[trimesh.Trimesh]:
    if isinstance(parts, list):
        for part in parts:
            yield from _flat(part)
    else:
        yield parts


def _value(expression: str, names: Names, table: str) -> Any:
    try:
        return eval(_compiled(expression), names)
    except Exception as error:
        raise ValueError(f"Furniture table '{table}', row {expression}: {error}") from error


@cache
def _compiled(expression: str) -> CodeType:
    return compile(expression, "<furniture table>", "eval")


def _books(rng: np.random.Generator, w: float, h: float, d: float, x: float, y: float) -> Parts:
    """Runs of books of unequal height from the left; the rest of the shelf stays empty."""
    parts, edge = [], x - w / 2 + 0.01
    limit = x + w / 2 - rng.uniform(0.05, 0.4) * w
    while edge < limit:
        run = min(rng.uniform(0.06, 0.18), x + w / 2 - 0.01 - edge)
        if run < 0.03:
            break
        tall, deep = h * rng.uniform(0.55, 0.9), d * rng.uniform(0.6, 0.85)
        parts.append(box(run * 0.96, tall, deep, edge + run / 2, y, -d * 0.04))
        edge += run
    return parts

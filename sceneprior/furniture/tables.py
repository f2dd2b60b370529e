"""Builds furniture from tables of parts: `beds.yaml`, `seats.yaml` and the other YAML files here.

A table is a name and a list of rows. A row is an expression that makes one or more parts (a solid
of `solids.py`, or another table), optionally repeated with `for`:

    desk:
    - box(w, 0.04, d, y=h - 0.04)
    - box(0.05, h, 0.05, x, 0, z) for x, z in corners(w/2 - 0.1, d/2 - 0.1)

A row may use the piece's width, height and depth `w`, `h`, `d` in metres, the index of its `style`,
all of `VOCABULARY`, and the random functions `uniform`, `random`, `integers` and `books`. A table
that other tables call names its parameters, as in `door(w, h, x, y, z, handle_x)`. Instead of a
list of rows, a table or a row may be a mapping with these keys, evaluated in this order:

    for:     loop over all keys below, such as `x in both(w/4)`
    let:     names for values that several rows use
    parts:   rows
    styles:  rows of each style, by name; the entry `style`, modulo their number, is used
    last:    rows after those of the style

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

from sceneprior.furniture.solids import PARTS, Number, Parts, Vector, box

DEEP_SOFA_M = 1.3
"""Minimum depth of a sofa with a chaise; sofas with a single row of seats are less deep."""

DINING_WIDTH_M = 1.0
"""Minimum width of a dining table; narrower tables are side tables."""


VOCABULARY: dict[str, Any] = {
    **PARTS,
    **{each: getattr(np, each) for each in ("arange", "array", "clip", "cos", "linspace", "sin")},
    "pi": np.pi,
    "product": product,
    # Positions of parts on both sides, in the four corners, or in a ring.
    "both": lambda x: (-x, x),
    "corners": lambda x, z: ((-x, -z), (-x, z), (x, -z), (x, z)),
    "around": lambda count, x, z: [
        (x * np.sin(turn), z * np.cos(turn)) for turn in np.arange(count) * 2 * np.pi / count
    ],
    "DEEP_SOFA_M": DEEP_SOFA_M,
    "DINING_WIDTH_M": DINING_WIDTH_M,
}
"""Names that the rows of every table may use, besides Python's `min`, `max`, `round` and so on."""

Names = dict[str, Any]
Rows = str | list[Any] | dict[str, Any]
_KEYS = {"for", "let", "parts", "styles", "last"}


@dataclass(frozen=True)
class Table:
    """One table of parts; `bind` maps its parameters to the arguments of a call."""

    name: str
    bind: Callable[..., Names]
    rows: Rows

    @classmethod
    def parse(cls, heading: str, rows: Rows) -> "Table":
        """Parse a table from its heading, `name` or `name(w, h, t=0.025)`, and its rows."""
        name, _, parameters = heading.rstrip(")").partition("(")
        return cls(name, eval(f"lambda {parameters or 'w, h, d, style'}: locals()"), rows)

    def build(self, names: Names, *values: Any) -> Parts:
        """Build the parts for these values of the parameters."""
        return list(_parts(self.rows, names | self.bind(*values), self.name))


@cache
def furniture_tables() -> dict[str, Table]:
    """Load all tables, by name."""
    found: dict[str, Table] = {}
    for file in files("sceneprior.furniture").iterdir():
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
    """Build the parts of a piece of furniture, about as large as `size_m`, from `tables`.

    A row that cannot be evaluated is a ValueError that names the table and the row.
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


def _books(
    rng: np.random.Generator, w: Number, h: Number, d: Number, x: Number, y: Number
) -> Parts:
    """Fill a shelf from the left with runs of books of unequal heights; the rest stays empty."""
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

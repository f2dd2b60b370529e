"""A table of instance ids and a label set in; the class of every id out."""

import csv
import io
import json
from collections.abc import Iterable
from pathlib import Path

from sceneprior.classes import LABEL_SETS, label_set_name
from sceneprior.errors import InputError

TABLES = ("classes.json", "classes.csv")
SHELL = frozenset(
    ["background", "wall", "floor", "ceiling", "door", "window", "blinds", "mirror", "picture"]
)
"""Classes of the room itself: nothing, unless the label set has them. Furniture stands against
them in the image, and none of them hides it."""
LARGEST_ID = 65_535


def read_label_set(text: str) -> str:
    """The name of the label set that `--label-set` names, or lists in a file.

    Args:
        text: A label set's name, or a file: one class a line, or a JSON list. `void` need not be
            in it; a line that begins with # is passed over.

    Returns:
        What `sceneprior.classes.label_set` understands, and a config's `label_set` takes.

    Raises:
        InputError: neither; or the file holds no proper list.
    """
    path = Path(text)
    if not path.is_file():
        if text in LABEL_SETS:
            return text
        if text.startswith("void,"):
            return label_set_name([name.strip() for name in text.split(",")[1:]])
        raise InputError(
            f"--label-set {text} is neither a file with a class a line, nor one of "
            f"{', '.join(LABEL_SETS)}, nor a list such as void,bed,chair."
        )
    try:
        content = path.read_text(encoding="utf-8")
        names = (
            json.loads(content)
            if path.suffix.lower() == ".json"
            else [line.strip() for line in content.splitlines()]
        )
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} holds no class names ({str(error)[:120]}).") from None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{path} holds no list of class names.")
    try:
        return label_set_name(
            [name for name in names if name and name != "void" and not name.startswith("#")]
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def read_classes(folder: Path) -> dict[int, str]:
    """Instance id -> class name, from a room's `classes.json` or `classes.csv`.

    JSON is an object `{"1": "bed", "2": "chair"}`; CSV has rows `id,class` under a header or none.

    Raises:
        InputError: there is no table, or two; it cannot be read; an id is no number from 1 to
            65,535, or is there twice.
    """
    found = [Path(folder) / name for name in TABLES if (Path(folder) / name).is_file()]
    if len(found) != 1:
        why = "has no classes.json or classes.csv" if not found else "has two tables of classes"
        raise InputError(f"{folder} {why}; one table says which class each instance id is.")
    path = found[0]
    try:
        content = path.read_text(encoding="utf-8-sig")
        pairs = _json_rows(path, content) if path.suffix == ".json" else _csv_rows(content)
    except (OSError, ValueError, RecursionError, csv.Error) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} cannot be read ({str(error)[:120]}).") from None
    classes: dict[int, str] = {}
    for key, name in pairs:
        if not (key.isascii() and key.isdigit()) or not 0 < int(key[:9]) <= LARGEST_ID:
            raise InputError(
                f"{path}: '{key[:40]}' is no instance id; expected a number from 1 to {LARGEST_ID} "
                "(0 is nothing)."
            )
        if int(key) in classes:
            raise InputError(f"{path}: instance id {int(key)} is there twice.")
        classes[int(key)] = name
    if not classes:
        raise InputError(f"{path} is empty; expected a class for each instance id.")
    return classes


def _json_rows(path: Path, content: str) -> Iterable[tuple[str, str]]:
    # As pairs, so that a repeated key is seen.
    data = json.loads(content, object_pairs_hook=list)
    if (
        not isinstance(data, list)
        or not all(isinstance(row, tuple) for row in data)
        or not all(isinstance(name, str) for _, name in data)
    ):
        raise InputError(
            f'{path} is not an object of ids and class names, as {{"1": "bed", "2": "chair"}} is.'
        )
    return [(key.strip(), name) for key, name in data]


def _csv_rows(content: str) -> Iterable[tuple[str, str]]:
    rows = [row for row in csv.reader(io.StringIO(content)) if any(cell.strip() for cell in row)]
    if rows and not rows[0][0].strip().isdigit():
        rows = rows[1:]
    for row in rows:
        if len(row) < 2:
            raise ValueError(f"a row '{row[0][:40]}' has no class")
    return [(row[0].strip(), row[1]) for row in rows]


def tidy(name: str) -> str:
    """How names are compared: `Night_Stand` and `night stand` are one.

    >>> tidy(" Night_Stand ")
    'night stand'
    """
    return " ".join(name.lower().replace("_", " ").replace("-", " ").split())

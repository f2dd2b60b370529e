"""Reads the user's label set, and a room's table of classes."""

import json
from pathlib import Path

from sceneprior.classes import LABEL_SETS, label_set_name
from sceneprior.errors import InputError
from sceneprior.instances.tables import read_class_table

TABLES = ("classes.json", "classes.csv")


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

    Raises:
        InputError: there is no table, or two; or see `read_class_table`.
    """
    found = [Path(folder) / name for name in TABLES if (Path(folder) / name).is_file()]
    if len(found) != 1:
        why = "has no classes.json or classes.csv" if not found else "has two tables of classes"
        raise InputError(f"{folder} {why}; one table says which class each instance id is.")
    return read_class_table(found[0])

"""Reads the user's label set, and finds a room's class table."""

import json
from pathlib import Path

from sceneprior.core.classes import LABEL_SETS, label_set_name
from sceneprior.core.errors import InputError

PANOPTIC = "panoptic.json"
TABLES = ("classes.json", "classes.csv", PANOPTIC)


def read_label_set(text: str) -> str:
    """Resolve `--label-set` to the name of a label set, as for `label_set` in a config.

    The text is such a name, or a file with one class per line or a JSON list. The file need not
    contain `void`; lines that begin with # are skipped.
    """
    path = Path(text)
    if not path.is_file():
        if text in LABEL_SETS:
            return text
        if text.startswith("void,"):
            return label_set_name([name.strip() for name in text.split(",")[1:]])
        raise InputError(
            f"--label-set {text} is neither a file with one class per line, nor one of "
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


def find_table(folder: Path) -> Path:
    """Find the only table in a folder that maps the room's ids to classes: one of `TABLES`."""
    found = [Path(folder) / name for name in TABLES if (Path(folder) / name).is_file()]
    if len(found) != 1:
        named = " and ".join(path.name for path in found) or f"no {' or '.join(TABLES)}"
        raise InputError(f"{folder} has {named}; expected one table with the class of each id.")
    return found[0]

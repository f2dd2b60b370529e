"""Finds 3D-FRONT's house files, and makes texts from them printable."""

from pathlib import Path
from typing import Any

from sceneprior.core.errors import InputError
from sceneprior.core.files import is_name


def house_files(folder: Path) -> list[Path]:
    """The house files of a 3D-FRONT folder, sorted.

    Raises:
        InputError: the folder is missing or holds no JSON.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(
            f"No folder at {folder}; --front names the folder of 3D-FRONT's house JSONs."
        )
    if (folder / "model_info.json").exists():
        raise InputError(f"{folder} holds furniture models, not houses; give it as --future.")
    inside = folder / "3D-FRONT"
    files = [] if inside.is_dir() else sorted(folder.glob("*.json"))
    if not files:
        hint = f"; did you mean {inside}?" if inside.is_dir() else "."
        raise InputError(f"{folder} holds no house JSONs (<uid>.json){hint}")
    return files


def shown(text: Any) -> str:
    """Make a text from a file printable and short, for reports."""
    if is_name(text):
        return str(text)
    try:
        return ascii(text)[:60]
    except RecursionError:
        return "something deeply nested"

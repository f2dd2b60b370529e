"""What lies where in 3D-FRONT and 3D-FUTURE, and JSON read with a sentence for every damage."""

import json
from pathlib import Path
from typing import Any

from sceneprior.errors import InputError

MODEL_FILE = "raw_model.obj"
_LONGEST_NAME = 120


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


def model_info_path(folder: Path) -> Path:
    """3D-FUTURE's list of models.

    Raises:
        InputError: the folder is missing, or has none.
    """
    if not folder.is_dir():
        raise InputError(f"No folder at {folder}; --future names the folder of 3D-FUTURE models.")
    for name in ("model_info.json", "model_info_revised.json"):
        if (folder / name).is_file():
            return folder / name
    raise InputError(
        f"{folder} has no model_info.json (nor model_info_revised.json), so it is not a folder "
        "of 3D-FUTURE models; --future usually ends in 3D-FUTURE-model."
    )


def file_stamp(path: Path) -> tuple[int, int]:
    """Time of change and size: what tells a changed file from the one that was read.

    Raises:
        InputError: there is no such file.
    """
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from None
    return status.st_mtime_ns, status.st_size


def read_json(path: Path) -> Any:
    """The JSON of a file.

    Raises:
        InputError: it cannot be read, or is none.
    """
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path.name} is not JSON ({error}); it may be truncated.") from None


def is_name(text: Any) -> bool:
    """Whether a text out of a file can be part of a path and of a report: short and printable."""
    return (
        isinstance(text, str)
        and 0 < len(text) <= _LONGEST_NAME
        and text.isprintable()
        and text not in (".", "..")
        and "/" not in text
    )


def shown(text: Any) -> str:
    """A text out of a file as a report can show it: printable and short."""
    if is_name(text):
        return str(text)
    try:
        return ascii(text)[:60]
    except RecursionError:
        return "something deeply nested"

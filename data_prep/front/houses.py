"""Finds and parses houses' JSON files, and checks the parts that all rooms of a house share."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json


@dataclass(frozen=True)
class House:
    """A parsed house file, before its rooms are read."""

    name: str
    """`<house uid>`, from the file's name."""
    rooms: list[Any]
    """Entries of `scene.room`, unchecked."""
    furniture: dict[str, dict[str, Any]]
    meshes: dict[str, dict[str, Any]]
    """Furniture and mesh entries by uid."""


def house_files(folder: Path) -> list[Path]:
    """The house files of a 3D-FRONT folder, sorted; raises InputError if it holds none."""
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


def parse_house(path: Path) -> House:
    """Read the JSON of one house; raises InputError if the file is not a house."""
    data = read_json(path)
    lists = {
        "furniture": _inside(data, "furniture"),
        "mesh": _inside(data, "mesh"),
        "scene.room": _inside(_inside(data, "scene"), "room"),
    }
    for key, entries in lists.items():
        if not isinstance(entries, list):
            raise InputError(f"{path.name} is not a 3D-FRONT house: it has no list '{key}'.")
    return House(
        path.stem, lists["scene.room"], _by_uid(lists["furniture"]), _by_uid(lists["mesh"])
    )


def _inside(data: Any, key: str) -> Any:
    return data.get(key) if isinstance(data, dict) else None


def is_valid(entry: dict[str, Any]) -> bool:
    """Test whether 3D-FRONT marks a furniture entry as valid; absent, null and false mean no."""
    value = entry.get("valid")
    return value.strip().lower() in ("true", "1") if isinstance(value, str) else bool(value)


def key_of(uid: Any) -> str:
    """Normalise a `uid` or `ref`, usually a string, sometimes a number; "" for anything else."""
    return str(uid) if isinstance(uid, str | int) and uid != "" else ""


def _by_uid(entries: list[Any]) -> dict[str, dict[str, Any]]:
    """Index entries by uid; among entries with the same uid, a valid entry is preferred."""
    found: dict[str, dict[str, Any]] = {}
    for entry in entries:
        key = key_of(entry.get("uid")) if isinstance(entry, dict) else ""
        if key and (key not in found or (is_valid(entry) and not is_valid(found[key]))):
            found[key] = entry
    return found

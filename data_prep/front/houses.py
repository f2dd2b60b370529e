"""Parses a house's JSON file, checked as far as all its rooms need it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sceneprior.errors import InputError
from sceneprior.files import read_json


@dataclass(frozen=True)
class House:
    """One house file, parsed, its rooms not read yet."""

    name: str
    """`<house uid>`, from the file's name."""
    rooms: list[Any]
    """Entries of `scene.room`, as they are."""
    furniture: dict[str, dict[str, Any]]
    """By uid."""
    meshes: dict[str, dict[str, Any]]
    """By uid."""


def parse_house(path: Path) -> House:
    """Read the JSON of one house.

    Raises:
        InputError: the file is not a house.
    """
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
    """Whether 3D-FRONT keeps a furniture entry: where not, `valid` is absent, null or false."""
    value = entry.get("valid")
    return value.strip().lower() in ("true", "1") if isinstance(value, str) else bool(value)


def key_of(uid: Any) -> str:
    """What `uid` and `ref` have in common: a text, now and then a number; else nothing."""
    return str(uid) if isinstance(uid, str | int) and uid != "" else ""


def _by_uid(entries: list[Any]) -> dict[str, dict[str, Any]]:
    """A repeated uid carries the same model, but not always the same `valid`: a valid one wins."""
    found: dict[str, dict[str, Any]] = {}
    for entry in entries:
        key = key_of(entry.get("uid")) if isinstance(entry, dict) else ""
        if key and (key not in found or (is_valid(entry) and not is_valid(found[key]))):
            found[key] = entry
    return found

"""plan.json: the assignment of rooms to shards, fixed before the first room is drawn."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from data_prep.engine.source import SPLITS, Line, RoomTask, Source
from sceneprior.core.errors import InputError
from sceneprior.core.shards import INDEX_NAME

PLAN_NAME = "plan.json"
PLAN_VERSION = 3
ROOMS_PER_SHARD = 8


@dataclass(frozen=True)
class ShardPlan:
    """The rooms of one shard, the unit of work: an interrupted run loses one shard per worker."""

    name: str
    """Path within the output folder: `train/bedroom_0000.h5`."""
    rooms: tuple[RoomTask, ...]


@dataclass(frozen=True)
class Plan:
    """All work of a run, and of later runs in the same folder."""

    settings: dict[str, Any]
    """Settings of the source, and the type of renderer (None if nothing is drawn)."""
    rooms: tuple[RoomTask, ...]
    left_out: tuple[Line, ...]
    """Rooms that the survey left out."""

    def shards(self, room_type: str) -> list[ShardPlan]:
        """Group the rooms of each split, in order, into shards of `ROOMS_PER_SHARD`."""
        shards = []
        for split in SPLITS:
            rooms = tuple(room for room in self.rooms if room.split == split)
            for i in range(0, len(rooms), ROOMS_PER_SHARD):
                name = f"{split}/{room_type}_{i // ROOMS_PER_SHARD:04d}.h5"
                shards.append(ShardPlan(name, rooms[i : i + ROOMS_PER_SHARD]))
        return shards


def job_settings(source: Source, only: str | None) -> dict[str, Any]:
    """Settings that must be equal for a run to resume in a folder, except the renderer."""
    settings = {"plan_version": PLAN_VERSION, "source": source.name, "only": only}
    return json.loads(json.dumps(settings | source.settings(only)))


def read_plan(out: Path, source: Source, settings: dict[str, Any], renderer: str) -> Plan | None:
    """Read the plan of an earlier run with the same `job_settings`; None if there was none.

    `--renderer auto` resumes with the renderer of that run; `--only` may work on part of a folder
    that was begun without it.
    """
    path = out / PLAN_NAME
    if not path.is_file():
        if any(out.glob("*/*.h5")) or (out / INDEX_NAME).exists():
            raise InputError(f"{out} holds shards without a {PLAN_NAME}; choose a new folder.")
        return None
    try:
        data = json.loads(path.read_bytes())
        before = dict(data["settings"])
        if (version := before["plan_version"]) != PLAN_VERSION:
            why = f"was written by another release (plan version {version})"
            raise InputError(f"{path} {why}; choose a new folder, or delete {out}.")
        drawn_with = before.pop("renderer")
        plan = TypeAdapter(Plan).validate_python(data)
    except (OSError, ValidationError, json.JSONDecodeError, KeyError, TypeError):
        raise InputError(f"{path} cannot be read; choose a new folder, or delete {out}.") from None
    if source.only is not None and before.get("only", "") is None:
        settings = job_settings(source, None)
    changed = [key for key in settings if before.get(key) != settings[key]]
    if source.draws and renderer not in ("auto", drawn_with):
        changed.append("renderer")
    if changed:
        raise InputError(
            f"{out} was begun with other settings ({', '.join(changed)} differ); "
            "give --out a new folder, or delete this one."
        )
    return plan


def digest(text: str) -> str:
    """Hash a long setting to a short fingerprint."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def digest_of_files(paths: Sequence[Path]) -> str:
    """Fingerprint of names and sizes: quick, and enough to notice another release."""
    try:
        return digest("".join(f"{path.name} {path.stat().st_size}\n" for path in paths))
    except OSError as error:
        raise InputError(f"{error.filename} cannot be read ({error.strerror}).") from None

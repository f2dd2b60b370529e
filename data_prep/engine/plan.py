"""plan.json: which rooms go into which shard, fixed before the first one is drawn."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from data_prep.engine.report import Line, read_line
from data_prep.engine.source import SPLITS, RoomTask, Source
from sceneprior.errors import InputError
from sceneprior.files import write_json
from sceneprior.shards import INDEX_NAME

PLAN_NAME = "plan.json"
PLAN_VERSION = 2
ROOMS_PER_SHARD = 8


@dataclass(frozen=True)
class ShardPlan:
    """One shard: the unit of work, and of what a stop can lose."""

    name: str
    """`train/bedroom_0000.h5`, within the output folder."""
    rooms: tuple[RoomTask, ...]


@dataclass(frozen=True)
class Plan:
    """All that a run, and every later run in the same folder, will do."""

    settings: dict[str, Any]
    """Of the source, and the renderer's kind (None where nothing is drawn)."""
    rooms: tuple[RoomTask, ...]
    left_out: tuple[Line, ...]
    """Rooms that the survey left out."""

    def shards(self, room_type: str) -> list[ShardPlan]:
        """A few rooms a shard, in the order of the rooms."""
        shards = []
        for split in SPLITS:
            rooms = tuple(room for room in self.rooms if room.split == split)
            for i in range(0, len(rooms), ROOMS_PER_SHARD):
                name = f"{split}/{room_type}_{i // ROOMS_PER_SHARD:04d}.h5"
                shards.append(ShardPlan(name, rooms[i : i + ROOMS_PER_SHARD]))
        return shards


def job_settings(source: Source, only: str | None) -> dict[str, Any]:
    """What must be equal for a run to go on with a folder, but for the renderer.

    Raises:
        InputError: the source's folders are wrong.
    """
    settings = {"plan_version": PLAN_VERSION, "source": source.name, "only": only}
    return json.loads(json.dumps(settings | source.settings(only)))


def write_plan(out: Path, plan: Plan) -> None:
    """Write plan.json.

    Raises:
        OSError: it cannot be written.
    """
    write_json(
        out / PLAN_NAME,
        {
            "settings": plan.settings,
            "rooms": [asdict(room) for room in plan.rooms],
            "left_out": [asdict(line) for line in plan.left_out],
        },
    )


def read_plan(out: Path, source: Source, settings: dict[str, Any], renderer: str) -> Plan | None:
    """The plan of an earlier run with these settings (`job_settings`), or None if there was none.

    `--renderer auto` goes on with the renderer that run had; `--only` works on a part of a folder
    that was begun for everything.

    Raises:
        InputError: the folder was begun with other settings, or its plan is damaged.
    """
    path = out / PLAN_NAME
    if not path.is_file():
        if any(out.glob("*/*.h5")) or (out / INDEX_NAME).exists():
            raise InputError(f"{out} holds shards without a {PLAN_NAME}; choose a new folder.")
        return None
    try:
        data = json.loads(path.read_text())
        before = dict(data["settings"])
        drawn_with = before.pop("renderer")
        plan = Plan(
            data["settings"],
            tuple(RoomTask(**room) for room in data["rooms"]),
            tuple(read_line(line) for line in data["left_out"]),
        )
    except (OSError, ValueError, KeyError, TypeError):
        older = _older_version(path)
        why = f"is of another release (plan version {older})" if older else "cannot be read"
        raise InputError(f"{path} {why}; choose a new folder, or delete {out}.") from None
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


def _older_version(path: Path) -> int | None:
    try:
        version = json.loads(path.read_text())["settings"]["plan_version"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return version if isinstance(version, int) and version != PLAN_VERSION else None


def digest(text: str) -> str:
    """A short fingerprint, for settings that are long."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def digest_of_files(paths: Sequence[Path]) -> str:
    """A fingerprint of names and sizes: enough to notice another release, and quick.

    Raises:
        InputError: a file is gone.
    """
    try:
        return digest("".join(f"{path.name} {path.stat().st_size}\n" for path in paths))
    except OSError as error:
        raise InputError(f"{error.filename} cannot be read ({error.strerror}).") from None

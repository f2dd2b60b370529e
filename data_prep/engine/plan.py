"""plan.json: the rooms of a job, their splits and shards, fixed before the first is drawn."""

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from data_prep.engine.source import Line, RoomTask, Source, Survey
from sceneprior.core.checked import plain
from sceneprior.core.errors import InputError
from sceneprior.core.files import list_files, read_table, reading
from sceneprior.core.shards import INDEX_NAME, SPLITS

PLAN_NAME = "plan.json"
PLAN_VERSION = 4
ROOMS_PER_SHARD = 8


@dataclass(frozen=True)
class ShardTask:
    """The rooms of one shard, the unit of work: an interrupted run loses one shard per worker."""

    name: str
    """Path within the output folder: `train/bedroom_0000.h5`."""
    rooms: tuple[RoomTask, ...]

    @property
    def room_ids(self) -> list[str]:
        return [room.room_id for room in self.rooms]


@dataclass(frozen=True)
class JobPlan:
    """All work of a run, and of later runs in the same folder."""

    settings: dict[str, Any]
    """Settings of the source, and the type of renderer (None if nothing is drawn). `houses`, if
    present, has the size of each house's file; of houses that the survey could not read, sizes are
    not compared."""
    rooms: tuple[RoomTask, ...]
    left_out: tuple[Line, ...]
    """Rooms that the survey left out."""

    def joined(self, survey: Survey, only: str | None, settings: dict[str, Any]) -> "JobPlan":
        """The plan with the rooms of a later survey that the first one left out, at the end.

        `only` and `settings` are those of the later survey.
        """
        known = {room.room_id for room in self.rooms}
        for line in survey.left_out:  # such as rooms of another image size than most have now
            if line.room_id in known:
                raise InputError(
                    f"Room {line.room_id} would now be left out ({line.reason.rstrip('.')}); give "
                    "--out a new folder."
                )
        new = (room for room in survey.rooms if room.room_id not in known)
        others = (
            line for line in self.left_out if not is_asked_for(only, line.room_id, line.house)
        )
        before = self.settings.get("houses", {})
        sizes = {name: before[name] for name in before if not house_may_match(only, name)}
        now = self.settings | {"houses": sizes | settings.get("houses", {})}
        return JobPlan(now, (*self.rooms, *new), (*others, *survey.left_out))

    def shards(self, room_type: str) -> list[ShardTask]:
        """Group the rooms of each split, in order, into shards of `ROOMS_PER_SHARD`."""
        shards = []
        for split in SPLITS:
            rooms = tuple(room for room in self.rooms if room.split == split)
            for i in range(0, len(rooms), ROOMS_PER_SHARD):
                name = f"{split}/{room_type}_{i // ROOMS_PER_SHARD:04d}.h5"
                shards.append(ShardTask(name, rooms[i : i + ROOMS_PER_SHARD]))
        return shards


def job_settings(source: Source, only: str | None) -> dict[str, Any]:
    """Settings that `read_plan` compares, all but the renderer."""
    settings = {"plan_version": PLAN_VERSION, "source": source.name, "only": only}
    return json.loads(json.dumps(settings | source.settings(only)))


def read_plan(out: Path, source: Source, settings: dict[str, Any], renderer: str) -> JobPlan | None:
    """Read the plan of an earlier run with the same settings; None if there was none.

    `--renderer auto` resumes with the renderer of that run; `--only` may work on part of a folder
    that was begun without it.
    """
    path = out / PLAN_NAME
    if not path.is_file():
        if list_files(out, "*.h5", deep=True) or (out / INDEX_NAME).exists():
            raise InputError(f"{out} holds shards without a {PLAN_NAME}; choose a new folder.")
        return None
    with reading(path, then=f"; choose a new folder, or delete {out}."):
        data = json.loads(path.read_bytes())
        before = dict(data["settings"])
        if (version := before["plan_version"]) != PLAN_VERSION:
            why = f"was written by another release (plan version {version})"
            raise InputError(f"{path} {why}; choose a new folder, or delete {out}.")
        drawn_with = before.pop("renderer")
        plan = TypeAdapter(JobPlan).validate_python(data)
    if source.only is not None and before.get("only", "") is None:
        settings = job_settings(source, None)
    lost = {line.house for line in plan.left_out if line.status == "failed"}
    lost -= {room.house for room in plan.rooms}
    settings = dict(settings)
    for values in (before, settings):  # a lost house may have been replaced
        sizes = values.get("houses", {})
        values["houses"] = {name: sizes[name] for name in sizes if name not in lost}
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


def house_may_match(only: str | None, house: str) -> bool:
    """Test whether `--only` may select rooms of a house; a prefix of its name suffices."""
    return only is None or house.startswith(only.partition("/")[0]) or only.startswith(f"{house}_")


def is_asked_for(only: str | None, room_id: str, house: str) -> bool:
    """True if `--only HOUSE`, `HOUSE/ROOM` or a room id selects this room; None selects all rooms.

    Example:

        >>> is_asked_for("ab/Bedroom-1", "abcd_Bedroom-1", "abcd")
        True
    """
    if only is None:
        return True
    start, slash, room = only.partition("/")
    if slash:
        return house.startswith(start) and room_id == f"{house}_{room}"
    return house.startswith(start) or room_id == only


def read_splits(path: Path) -> dict[str, str]:
    """Read the split of each room or scene from a CSV of `id,split`, or with columns between the
    two, as in Hypersim's list of images; other rows are skipped."""
    meaning = {"train": "train", "test": "test", "val": "val", "validation": "val"}
    found: dict[str, str] = {}
    for name, *cells in filter(None, read_table(path, "name a split file")):
        words = [cell.strip().lower() for cell in cells]
        split = next((meaning[word] for word in words if word in meaning), None)
        if split is not None and (other := found.setdefault(name.strip(), split)) != split:
            raise InputError(
                f"{path}: {plain(name)} is in {other} and in {split}; expected one split."
            )
    if not found:
        raise InputError(f"{path} has no rows `room id,split` with split train, val or test.")
    return found


def seeded_split(
    room_ids: Iterable[str], seed: int, test_share: float = 0.1, val_share: float = 0.0
) -> dict[str, str]:
    """Assign room ids to splits in the order of a seeded hash of each id.

    The relative order of two ids does not depend on the others. A split with a nonzero share gets
    at least one room, `test` before `val`, as long as one is left for `train`.
    """
    order = sorted(room_ids, key=lambda item: hashlib.sha256(f"{seed}:{item}".encode()).digest())
    names: list[str] = []
    for split, share in (("test", test_share), ("val", val_share)):
        if share > 0:
            names += [split] * min(round(share * len(order)) or 1, len(order) - len(names) - 1)
    return dict(zip(order, names + ["train"] * (len(order) - len(names)), strict=True))


def of_one_size(
    sizes: Mapping[str, tuple[int, int]], houses: Mapping[str, str]
) -> tuple[list[str], list[Line]]:
    """Keep the rooms whose images have the most frequent (height, width).

    Batches hold images of several rooms, so all rooms of a folder must have one size. Returns the
    ids of the rooms that are kept, and lines of the report for the others; `houses` has the house
    of each room.
    """
    usual = Counter(sizes.values()).most_common(1)[0][0] if sizes else (0, 0)
    kept, left_out = [], []
    for room_id, size in sizes.items():
        if size == usual:
            kept.append(room_id)
            continue
        why = (
            f"its views are {size[1]} x {size[0]} pixels, those of most rooms {usual[1]} x "
            f"{usual[0]}, and all shards of a folder need one size; prepare it separately"
        )
        left_out.append(Line(room_id, houses[room_id], "filtered", "image_size", why))
    return kept, left_out


def select(survey: Survey, only: str | None, where: str, splits: str = "") -> Survey:
    """Reduce a survey to the rooms that `--only` selects; one to prepare must be left.

    `where` ends the error's sentence "No room of ...": "FOLDER passes the recipe NAME". `splits` is
    the origin of the splits, named in the error if `train` is empty; "" for seeded splits, whose
    `train` is never empty. `val` and `test` may be empty.
    """
    rooms = tuple(room for room in survey.rooms if is_asked_for(only, room.room_id, room.house))
    left_out = tuple(
        item for item in survey.left_out if is_asked_for(only, item.room_id, item.house)
    )
    if not rooms:
        about = f" for --only {only}" if only else ""
        raise InputError(f"No room of {where}{about} ({in_words(left_out)}).")
    if splits and only is None and not any(room.split == "train" for room in rooms):
        raise InputError(
            f"The 'train' split is empty: none of the {len(rooms)} usable rooms is in it. "
            f"Check {splits}."
        )
    return Survey(rooms, left_out)


def in_words(left_out: Iterable[Line]) -> str:
    """Number of rooms left out, and the most frequent reason."""
    reasons = [item.reason for item in left_out]
    # Reasons that differ only in numbers count as one; the first is quoted.
    shapes = [re.sub(r"[\d.]+", "#", reason) for reason in reasons]
    often = ""
    if shapes:
        shape = Counter(shapes).most_common(1)[0][0]
        often = f"; the most frequent reason: {reasons[shapes.index(shape)].rstrip('.')}"
    return f"{len(reasons)} were left out{often}"

"""Checks a folder of shards: checksums, shapes, ranges, boxes, masks and 3D ground truth."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from data_prep.engine.source import SPLITS
from data_prep.engine.workers import pool
from data_prep.inspection.agreement import Agreement, compare
from data_prep.inspection.bodies import found_bodies, true_bodies
from data_prep.inspection.causes import Trial, try_repairs
from data_prep.inspection.checks import array_problems, mask_problems, truth_problems
from data_prep.inspection.verdicts import disagreement, room_problems
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError, ShardError
from sceneprior.core.shard_writing import room_checksum
from sceneprior.core.shards import Shard, list_shards, read_index

_TRIED_ROOMS = 2
"""Rooms per shard in which camera repairs are tried; the others likely have the same fault."""


@dataclass(frozen=True)
class RoomCheck:
    """Results of checking one room."""

    shard: str
    room_id: str
    views: int = 0
    objects: int = 0
    problems: tuple[str, ...] = ()
    """Sentences without the room's name."""
    agreement: Agreement = field(default_factory=Agreement)
    trials: dict[str, Trial] = field(default_factory=dict)
    """Results of repairs by cause, tried in some of the rooms that disagree."""
    has_truth: bool = False
    has_checksum: bool = False


@dataclass(frozen=True)
class FolderCheck:
    """Results of checking a folder."""

    rooms: dict[str, list[RoomCheck]]
    """Rooms by split."""
    problems: tuple[str, ...]
    """Sentences, each with its place; empty if all is well."""

    @property
    def every(self) -> list[RoomCheck]:
        """Rooms of all splits."""
        return [room for rooms in self.rooms.values() for room in rooms]

    @property
    def agreement(self) -> Agreement:
        """Agreement summed over all rooms."""
        return sum((room.agreement for room in self.every), Agreement())


def verify(folder: Path, room_id: str | None = None, workers: int = 1) -> FolderCheck:
    """Check the consistency of a folder of shards.

    With `room_id`, only this room is checked, and the counts of the index are not.
    """
    folder = Path(folder)
    index = read_index(folder)
    name = str(index.get("label_set"))
    label_set(name)
    problems: list[str] = []
    rooms: dict[str, list[RoomCheck]] = {}
    for split in SPLITS:
        if not any((folder / split).glob("*.h5")):
            continue
        paths = list_shards(folder, split)
        arguments = [(folder, path, name, room_id) for path in paths]
        with pool(workers) as run:
            rooms[split] = [room for part in run(_check_shard, arguments, f"checking {split}")
                            for room in part]  # fmt: skip
    found = FolderCheck(rooms, ())
    if not found.every:
        raise InputError(
            f"{folder} has no room '{room_id}'; its report.csv lists the rooms."
            if room_id is not None
            else f"{folder} holds no rooms; prepare them again."
        )
    for room in found.every:
        path = str(folder / room.shard)
        where = path + (f", room {room.room_id}" if room.room_id else "")
        for sentence in room.problems:
            # Sentences about unreadable shards name their place themselves.
            text = sentence if sentence.startswith(path) else f"{where}: {sentence}"
            problems.append(text if text.endswith("?") else f"{text}.")
    if room_id is None:
        # Without a room's views, a problem already says what is missing.
        if all(room.views for room in found.every):
            problems += _count_problems(folder, index, rooms)
        trials = [room.trials for room in found.every if room.trials]
        for kind in found.agreement.failing():
            problems.append(f"{folder}: {disagreement(found.agreement, kind, trials)}")
    return replace(found, problems=tuple(problems))


def _count_problems(
    folder: Path, index: dict[str, Any], rooms: dict[str, list[RoomCheck]]
) -> Iterator[str]:
    counts = index.get("counts")
    for split, expected in counts.items() if isinstance(counts, dict) else ():
        checks = [room for room in rooms.get(split, ()) if room.room_id]
        found = {
            "rooms": len(checks),
            "views": sum(room.views for room in checks),
            "objects": sum(room.objects for room in checks),
        }
        for what, count in found.items():
            if expected.get(what, count) != count:
                yield (
                    f"{folder}: index.json counts {expected[what]} {what} in '{split}', but its "
                    f"shards hold {count}; run the same prep command again."
                )


def _check_shard(
    folder: Path, path: Path, label_set_name: str, only: str | None
) -> list[RoomCheck]:
    """Check every room of a shard, or only `only`; an unreadable shard is one problem."""
    name = str(path.relative_to(folder))
    checks: list[RoomCheck] = []
    try:
        with Shard(path) as shard:
            if shard.label_set != label_set_name:
                said = f"the shard is labelled '{shard.label_set}', index.json says"
                checks.append(RoomCheck(name, "", problems=(f"{said} '{label_set_name}'",)))
            for room_id in shard.room_ids:
                if only is None or room_id == only:
                    left = _TRIED_ROOMS - sum(bool(check.trials) for check in checks)
                    checks.append(_check_room(shard, folder, name, room_id, left > 0))
    except ShardError as error:
        checks.append(RoomCheck(name, "", problems=(str(error).removesuffix("."),)))
    return checks


def _check_room(shard: Shard, folder: Path, name: str, room_id: str, try_causes: bool) -> RoomCheck:
    truth = None
    try:
        views = shard.read_room(room_id, images=True)
        if shard.has_ground_truth(room_id):
            truth = shard.read_ground_truth(room_id)
        stored = shard.read_checksum(room_id)
    except ShardError as error:
        return RoomCheck(name, room_id, problems=(str(error).removesuffix("."),))
    problems = []
    if stored is not None and stored != room_checksum(views, truth):
        problems.append("its checksum does not match its contents: the file was changed or damaged")
    wrong = [*array_problems(views, len(label_set(shard.label_set)))]
    problems += [*wrong, *mask_problems(views)]
    if truth is not None:
        wrong += (found := [*truth_problems(views, truth)])
        problems += found
    check = RoomCheck(
        name, room_id, len(views.visible), len(views.object_class),
        problems=tuple(problems), has_truth=truth is not None, has_checksum=stored is not None,
    )  # fmt: skip
    if wrong:
        return check
    if truth is None:
        bodies = found_bodies(views)
    else:
        bodies, found = true_bodies(views, truth, folder)
        problems += found
    seen = compare(bodies, views)
    trials = {}
    if try_causes and seen.agreement.failing():
        trials = try_repairs(bodies, views)
    problems += room_problems(bodies, views, seen, [trials] if trials else [])
    return replace(check, problems=tuple(problems), agreement=seen.agreement, trials=trials)

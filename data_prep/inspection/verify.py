"""Checks a folder of shards: checksums, shapes, ranges, boxes, masks, cameras and ground truth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from data_prep.engine.source import SPLITS
from data_prep.engine.workers import pool
from data_prep.inspection.agreement import (
    Agreement,
    Limits,
    Room,
    added,
    compare,
    failing,
    true_bodies,
)
from data_prep.inspection.camera_convention import Convention, Conventions, read_conventions
from data_prep.inspection.checks import array_problems, mask_problems, truth_problems
from data_prep.inspection.diagnosis import (
    Finding,
    TrackTrial,
    disagreement,
    find_mistake,
    outliers,
    try_tracks,
)
from data_prep.inspection.evidence import Evidence, room_evidence, total
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError, ShardError
from sceneprior.core.shard_writing import room_checksum
from sceneprior.core.shards import Shard, list_shards, read_index

_TRIED_ROOMS = 3
"""Number of rooms in which objects are found without ids, or corrections of ground truth are
tried."""
_NAMED_ROOMS = 5
_ALL, _OF_ROOM = Limits(), Limits(share=0.7, masks=5)
"""Minima of agreement for all rooms, and for each, so that one wrong room does not go unnoticed
among many correct ones."""


@dataclass(frozen=True)
class RoomCheck:
    """Results of checking one room."""

    shard: str
    room_id: str
    views: int = 0
    objects: int = 0
    problems: tuple[str, ...] = ()
    """Problems as sentences, without the room's name."""
    evidence: Evidence | None = None
    """Evidence about cameras and ids; None if the arrays are faulty."""
    agreement: Agreement = field(default_factory=dict)
    """Agreement of ground truth and masks."""
    outliers: tuple[str, ...] = ()
    """Views and objects that disagree with the ground truth, as sentences."""
    has_checksum: bool = False


@dataclass(frozen=True)
class FolderCheck:
    """Results of checking a folder."""

    rooms: dict[str, list[RoomCheck]]
    """Rooms by split."""
    problems: tuple[str, ...]
    """Problems as sentences, each with its file or room; empty if nothing is wrong."""

    @property
    def every(self) -> list[RoomCheck]:
        """Rooms of all splits."""
        return [room for rooms in self.rooms.values() for room in rooms]


def evidence_of(checks: Sequence[RoomCheck]) -> Evidence | None:
    """Combined evidence of rooms; None if there is none."""
    known = [check.evidence for check in checks if check.evidence is not None]
    return total(known) if known else None


def agreement_of(checks: Sequence[RoomCheck]) -> Agreement:
    """Agreement summed over rooms."""
    return added(check.agreement for check in checks)


def verify(folder: Path, room_id: str | None = None, workers: int = 1) -> FolderCheck:
    """Check the consistency of a folder of shards.

    With `room_id`, only this room is checked, and the counts of the index are not.
    """
    folder = Path(folder)
    index = read_index(folder)
    name = str(index.get("label_set"))
    label_set(name)
    conventions, failures = read_conventions(folder, index.get("source"))
    problems = [f"{folder}: {failures}."] if failures and room_id is None else []
    rooms: dict[str, list[RoomCheck]] = {}
    for split in SPLITS:
        if not any((folder / split).glob("*.h5")):
            continue
        arguments = [
            (folder, path, name, room_id, conventions) for path in list_shards(folder, split)
        ]
        with pool(workers) as run:
            parts = run(_check_shard, arguments, f"checking {split}")
            rooms[split] = [room for part in parts for room in part]
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
            # Sentences about unreadable shards already name their file.
            text = sentence if sentence.startswith(path) else f"{where}: {sentence}"
            problems.append(text if text.endswith("?") else f"{text}.")
    # If a room has no views, one of the problems already states the reason.
    if room_id is None and all(room.views for room in found.every):
        problems += _count_problems(folder, index, rooms)
    problems += _mistakes(folder, found.every, conventions)
    return replace(found, problems=tuple(problems))


def _mistakes(folder: Path, rooms: Sequence[RoomCheck], conventions: Conventions) -> list[str]:
    """A sentence on the mistake in the cameras and ids of all rooms, or sentences on the rooms that
    differ; if there are no such mistakes, sentences on the ground truth."""

    def mistake(checks: Sequence[RoomCheck]) -> Finding | None:
        if (evidence := evidence_of(checks)) is None:
            return None
        origins = [conventions.of(check.room_id) for check in checks]
        files = [origin.file for origin in origins]
        origin = origins[files.index(max(files, key=files.count))]
        return find_mistake(evidence, origin, lambda: _tracks_of(folder, checks))

    if (finding := mistake(rooms)) is not None:
        return [f"{folder}: {finding.sentence}."]
    of: dict[object, list[RoomCheck]] = {}
    for room in rooms:
        if (finding := mistake([room])) is not None:
            of.setdefault(finding.key, []).append(room)
    sentences = []
    for checks in of.values():
        finding = mistake(checks) or mistake(checks[:1])
        assert finding is not None, "the first room alone has one"
        named = ", ".join(check.room_id for check in checks[:_NAMED_ROOMS])
        more = f" and {len(checks) - _NAMED_ROOMS} more" * (len(checks) > _NAMED_ROOMS)
        which = "room" if len(checks) == 1 else f"{len(checks)} of {len(rooms)} rooms,"
        sentences.append(f"{folder}, {which} {named}{more}: {finding.sentence}.")
    return sentences or _mistakes_in_3d(folder, rooms, conventions)


def _tracks_of(folder: Path, checks: Sequence[RoomCheck]) -> TrackTrial:
    most = sorted(checks, key=lambda check: -check.views)[:_TRIED_ROOMS]
    return try_tracks(_read(folder, check)[0] for check in most)


def _read(folder: Path, check: RoomCheck) -> Room:
    with Shard(folder / check.shard) as shard:
        views = shard.read_room(check.room_id, images=True)
        if not shard.has_ground_truth(check.room_id):
            return Room(views)
        return Room(views, true_bodies(views, shard.read_ground_truth(check.room_id), folder)[0])


def _mistakes_in_3d(
    folder: Path, rooms: Sequence[RoomCheck], conventions: Conventions
) -> list[str]:
    """Sentences about ground truth and masks, in all rooms together or in single ones."""

    def said(checks: Sequence[RoomCheck], limits: Limits, tried: Sequence[RoomCheck]) -> list[str]:
        if not (wrong := failing(agreement_of(checks), limits)):
            return []
        read = [(_read(folder, c), conventions.of(c.room_id)) for c in tried[:_TRIED_ROOMS]]
        return [disagreement(tally, read, limits) for tally in wrong]

    sentences = []
    wrong = [room for room in rooms if failing(room.agreement, _ALL)]
    if 2 * len(wrong) <= len(rooms):
        for room in rooms:
            where = f"{folder / room.shard}, room {room.room_id}"
            found = said([room], _OF_ROOM, [room]) or room.outliers
            sentences += [f"{where}: {sentence}." for sentence in found]
    if not sentences:
        sentences = [f"{folder}: {sentence}." for sentence in said(rooms, _ALL, wrong)]
    return [text.replace("?.", "?") for text in sentences]


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
    folder: Path, path: Path, label_set_name: str, only: str | None, conventions: Conventions
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
                    convention = conventions.of(room_id)
                    checks.append(_check_room(shard, folder, name, room_id, convention))
    except ShardError as error:
        checks.append(RoomCheck(name, "", problems=(str(error).removesuffix("."),)))
    return checks


def _check_room(
    shard: Shard, folder: Path, name: str, room_id: str, convention: Convention
) -> RoomCheck:
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
        problems=tuple(problems), has_checksum=stored is not None,
    )  # fmt: skip
    if wrong:
        return check
    check = replace(check, evidence=room_evidence(views, convention, truth is None))
    if truth is None:
        return check
    bodies, found = true_bodies(views, truth, folder)
    seen = compare(Room(views, bodies))
    odd = () if failing(seen.agreement, _OF_ROOM) else outliers(seen)
    return replace(
        check, problems=(*problems, *found), agreement=seen.agreement, outliers=tuple(odd)
    )

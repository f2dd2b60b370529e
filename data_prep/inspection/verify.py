"""Checks a folder of shards: checksums, shapes, ranges, boxes, masks, cameras and ground truth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from data_prep.engine.source import SPLITS
from data_prep.engine.workers import pool
from data_prep.inspection.agreement import ROOM_SHARE, Agreement, compare
from data_prep.inspection.bodies import true_bodies
from data_prep.inspection.checks import array_problems, mask_problems, truth_problems
from data_prep.inspection.evidence import Evidence, room_evidence, total
from data_prep.inspection.given import Given, given_of
from data_prep.inspection.tracking import Trial, add, try_tracks
from data_prep.inspection.truth_causes import try_repairs
from data_prep.inspection.truth_verdicts import ROOM_MASKS, disagreement, outliers
from data_prep.inspection.verdicts import Finding, find_mistake
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError, ShardError
from sceneprior.core.shard_writing import room_checksum
from sceneprior.core.shards import Shard, list_shards, read_index

_TRIED_ROOMS = 3
"""Number of rooms in which objects are found without ids, or ground-truth repairs are tried."""
_NAMED_ROOMS = 5


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
    agreement: Agreement = field(default_factory=Agreement)
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

    @property
    def agreement(self) -> Agreement:
        """Agreement summed over all rooms."""
        return sum((room.agreement for room in self.every), Agreement())

    @property
    def evidence(self) -> Evidence | None:
        """Combined evidence of all rooms; None if there is none."""
        return evidence_of(self.every)


def evidence_of(checks: Sequence[RoomCheck]) -> Evidence | None:
    """Combined evidence of rooms; None if there is none."""
    known = [check.evidence for check in checks if check.evidence is not None]
    return total(known) if known else None


def verify(folder: Path, room_id: str | None = None, workers: int = 1) -> FolderCheck:
    """Check the consistency of a folder of shards.

    With `room_id`, only this room is checked, and the counts of the index are not.
    """
    folder = Path(folder)
    index = read_index(folder)
    name = str(index.get("label_set"))
    label_set(name)
    usual, given, failures = given_of(folder, index.get("source"))
    problems = [f"{folder}: {failures}."] if failures and room_id is None else []
    rooms: dict[str, list[RoomCheck]] = {}
    for split in SPLITS:
        if not any((folder / split).glob("*.h5")):
            continue
        paths = list_shards(folder, split)
        arguments = [(folder, path, name, room_id, usual, given) for path in paths]
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
            # Sentences about unreadable shards already name their file.
            text = sentence if sentence.startswith(path) else f"{where}: {sentence}"
            problems.append(text if text.endswith("?") else f"{text}.")
    # If a room has no views, one of the problems already states the reason.
    if room_id is None and all(room.views for room in found.every):
        problems += _count_problems(folder, index, rooms)
    problems += _verdict(folder, found.every, usual, given)
    return replace(found, problems=tuple(problems))


def _verdict(
    folder: Path, rooms: Sequence[RoomCheck], usual: Given, given: dict[str, Given]
) -> list[str]:
    """A sentence on the mistake in the cameras and ids of all rooms, or sentences on the rooms that
    differ; if there are no such mistakes, sentences on the ground truth."""

    def mistake(checks: Sequence[RoomCheck]) -> Finding | None:
        if (evidence := evidence_of(checks)) is None:
            return None
        origins = [given.get(check.room_id, usual) for check in checks]
        names = [origin.file for origin in origins]
        origin = origins[names.index(max(names, key=names.count))]
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
    return sentences or _truth_verdict(folder, rooms, usual, given)


def _tracks_of(folder: Path, checks: Sequence[RoomCheck]) -> Trial:
    most = sorted(checks, key=lambda check: -check.views)[:_TRIED_ROOMS]
    trials = []
    for check in most:
        with Shard(folder / check.shard) as shard:
            trials.append(try_tracks(shard.read_room(check.room_id, images=True)))
    return add(trials)


def _truth_verdict(
    folder: Path, rooms: Sequence[RoomCheck], usual: Given, given: dict[str, Given]
) -> list[str]:
    """Sentences about ground truth and masks, in all rooms together or in single ones."""

    def trials(checks: Sequence[RoomCheck]) -> list[Any]:
        found = []
        for check in checks[:_TRIED_ROOMS]:
            with Shard(folder / check.shard) as shard:
                views = shard.read_room(check.room_id, images=True)
                bodies, _ = true_bodies(views, shard.read_ground_truth(check.room_id), folder)
            found.append(try_repairs(bodies, views, given.get(check.room_id, usual)))
        return found

    sentences = []
    wrong = [room for room in rooms if room.agreement.failing()]
    if 2 * len(wrong) <= len(rooms):
        for room in rooms:
            kinds = room.agreement.failing(ROOM_SHARE, ROOM_MASKS)
            tried = trials([room]) if kinds else []
            said = [
                disagreement(room.agreement, kind, tried, ROOM_SHARE, ROOM_MASKS) for kind in kinds
            ]
            where = f"{folder / room.shard}, room {room.room_id}"
            sentences += [f"{where}: {sentence}." for sentence in said or room.outliers]
    agreement = sum((room.agreement for room in rooms), Agreement())
    if not sentences and (kinds := agreement.failing()):
        tried = trials(wrong)
        sentences = [f"{folder}: {disagreement(agreement, kind, tried)}." for kind in kinds]
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
    folder: Path,
    path: Path,
    label_set_name: str,
    only: str | None,
    usual: Given,
    given: dict[str, Given],
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
                    origin = given.get(room_id, usual)
                    checks.append(_check_room(shard, folder, name, room_id, origin))
    except ShardError as error:
        checks.append(RoomCheck(name, "", problems=(str(error).removesuffix("."),)))
    return checks


def _check_room(shard: Shard, folder: Path, name: str, room_id: str, given: Given) -> RoomCheck:
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
    check = replace(check, evidence=room_evidence(views, given.convention, truth is None))
    if truth is None:
        return check
    bodies, found = true_bodies(views, truth, folder)
    seen = compare(bodies, views)
    odd = () if seen.agreement.failing(ROOM_SHARE, ROOM_MASKS) else outliers(bodies, views, seen)
    return replace(
        check, problems=(*problems, *found), agreement=seen.agreement, outliers=tuple(odd)
    )

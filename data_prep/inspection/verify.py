"""Checks a folder of shards: checksums, shapes, ranges, boxes, masks, cameras and ground truth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.engine.plan import in_words
from data_prep.engine.report import REPORT_NAME, Report, without_class
from data_prep.inspection.agreement import (
    Agreement,
    Limits,
    Room,
    added,
    compare,
    failing,
    true_bodies,
)
from data_prep.inspection.causes import Convention
from data_prep.inspection.diagnosis import Finding, disagreement, find_mistake, outliers
from data_prep.inspection.evidence import Evidence, room_evidence, total
from sceneprior.core.checked import checked
from sceneprior.core.classes import VOID, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.observations import RoomGroundTruth, RoomViews, observe
from sceneprior.core.parallel import run_tasks
from sceneprior.core.shard_writing import room_checksum
from sceneprior.core.shards import Shard, list_shards, read_index, splits_of

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
    convention: Convention = field(default_factory=Convention, compare=False)
    """Convention of the file that the cameras were read from."""


@dataclass(frozen=True)
class FolderCheck:
    """Results of checking a folder."""

    rooms: dict[str, list[RoomCheck]]
    """Rooms by split."""
    problems: tuple[str, ...]
    """Problems as sentences, each with its file or room; empty if nothing is wrong."""
    without_class: Sequence[str] = ()
    """A phrase on objects whose name is no class of the label set, if there are any."""

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


def verify(folder: Path, room_id: str | None = None) -> FolderCheck:
    """Check the consistency of a folder of shards.

    With `room_id`, only this room is checked, and the counts of the index are not.
    """
    folder = Path(folder)
    index = read_index(folder)
    name, source = index["label_set"], str(index.get("source"))
    label_set(name)
    usual, conventions, failures, unknown = read_conventions(folder, source)
    problems = [f"{folder}: {failures}."] if failures and room_id is None else []
    rooms: dict[str, list[RoomCheck]] = {}
    for split in splits_of(folder):
        tasks = {
            str(path): (folder, path, name, room_id, usual, conventions)
            for path in list_shards(folder, split)
        }
        parts = run_tasks(_check_shard, tasks, f"checking {split}")
        rooms[split] = [room for part in parts for room in part]
    found = FolderCheck(rooms, (), unknown)
    if not found.every:
        raise InputError(
            f"{folder} has no room '{room_id}'; its report.csv lists the rooms."
            if room_id is not None
            else f"{folder} holds no rooms; prepare them again."
        )
    for room in found.every:
        path = str(folder / room.shard)
        where = path + (f", room {room.room_id}" if room.room_id else "")
        # Sentences about unreadable shards already name their file.
        said = [text if text.startswith(path) else f"{where}: {text}" for text in room.problems]
        problems += [text if text.endswith("?") else f"{text}." for text in said]
    # If a room has no views, one of the problems already states the reason.
    if room_id is None and all(room.views for room in found.every):
        problems += _count_problems(folder, index, rooms)
    problems += _mistakes(folder, found.every)
    return replace(found, problems=tuple(problems))


def read_conventions(
    folder: Path, source: str
) -> tuple[Convention, dict[str, Convention], str | None, list[str]]:
    """The usual convention of a source, those of rooms whose file of poses the report names, by id,
    a sentence if more rooms failed than were prepared, and `without_class`.

    If the report is missing or from an earlier release, the usual convention is assumed.
    """
    usual = Convention.stated(source)
    try:
        lines = checked(Report, read_json(folder / REPORT_NAME), REPORT_NAME).rooms
        rooms = {
            line.room_id: Convention.stated(source, **line.cameras)
            for line in lines
            if line.cameras
        }
    except (InputError, TypeError, ValueError):
        return usual, {}, None, []
    failed = [line for line in lines if line.status == "failed"]
    prepared = sum(line.status == "prepared" for line in lines)
    said = f"{len(lines)} rooms, {prepared} prepared: {in_words(failed)}"
    return usual, rooms, said if len(failed) > prepared else None, without_class(lines)


def _mistakes(folder: Path, rooms: Sequence[RoomCheck]) -> list[str]:
    """A sentence on the mistake in the cameras and ids of all rooms, or sentences on the rooms that
    differ; if there are no such mistakes, sentences on the ground truth."""

    def mistake(checks: Sequence[RoomCheck]) -> Finding | None:
        if (evidence := evidence_of(checks)) is None:
            return None
        files = [check.convention.file for check in checks]
        usual = checks[files.index(max(files, key=files.count))].convention
        whole = [check for check in checks if check.evidence is not None]
        most = sorted(whole, key=lambda check: -check.views)[:_TRIED_ROOMS]
        return find_mistake(evidence, usual, lambda: (_read(folder, check).views for check in most))

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
    return sentences or _mistakes_in_3d(folder, rooms)


def _read(folder: Path, check: RoomCheck) -> Room:
    with Shard(folder / check.shard) as shard:
        views = shard.read_room(check.room_id, images=True)
        if not shard.has_ground_truth(check.room_id):
            return Room(views)
        return Room(views, true_bodies(views, shard.read_ground_truth(check.room_id), folder)[0])


def _mistakes_in_3d(folder: Path, rooms: Sequence[RoomCheck]) -> list[str]:
    """Sentences about ground truth and masks, in all rooms together or in single ones."""

    def said(checks: Sequence[RoomCheck], limits: Limits, tried: Sequence[RoomCheck]) -> list[str]:
        if not (wrong := failing(agreement_of(checks), limits)):
            return []
        read = [(_read(folder, check), check.convention) for check in tried[:_TRIED_ROOMS]]
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
    for split, expected in index.get("counts", {}).items():
        checks = [room for room in rooms.get(split, ()) if room.room_id]
        views, objects = (sum(getattr(room, of) for room in checks) for of in ("views", "objects"))
        for what, count in {"rooms": len(checks), "views": views, "objects": objects}.items():
            if expected[what] != count:
                yield (
                    f"{folder}: index.json counts {expected[what]} {what} in '{split}', but its "
                    f"shards hold {count}; run the same prep command again."
                )


def _check_shard(
    folder: Path,
    path: Path,
    label_set_name: str,
    only: str | None,
    usual: Convention,
    conventions: dict[str, Convention],
) -> list[RoomCheck]:
    """Check every room of a shard, or only `only`; an unreadable shard is one problem."""
    name = str(path.relative_to(folder))
    whole = RoomCheck(name, "", convention=usual)
    checks: list[RoomCheck] = []
    try:
        with Shard(path) as shard:
            if shard.label_set != label_set_name:
                said = f"the shard is labelled '{shard.label_set}', index.json says"
                checks.append(replace(whole, problems=(f"{said} '{label_set_name}'",)))
            for room_id in shard.room_ids:
                if only is None or room_id == only:
                    check = RoomCheck(name, room_id, convention=conventions.get(room_id, usual))
                    checks.append(_check_room(shard, folder, check))
    except InputError as error:
        checks.append(replace(whole, problems=(str(error).removesuffix("."),)))
    return checks


def _check_room(shard: Shard, folder: Path, check: RoomCheck) -> RoomCheck:
    truth, room_id = None, check.room_id
    try:
        views = shard.read_room(room_id, images=True)
        if shard.has_ground_truth(room_id):
            truth = shard.read_ground_truth(room_id)
        stored = shard.read_checksum(room_id)
    except InputError as error:
        return replace(check, problems=(str(error).removesuffix("."),))
    changed = "its checksum does not match its contents: the file was changed or damaged"
    problems = [changed] * (stored is not None and stored != room_checksum(views, truth))
    wrong = [*array_problems(views, len(names := label_set(shard.label_set)))]
    of_truth = [] if truth is None else [*truth_problems(views, truth)]
    problems += [*wrong, *mask_problems(views), *of_truth]
    check = replace(
        check, views=len(views.visible), objects=len(views.object_class),
        has_checksum=stored is not None, problems=tuple(problems),
    )  # fmt: skip
    if wrong or of_truth:
        return check
    known = None if truth else names
    check = replace(check, evidence=room_evidence(views, check.convention, known))
    if truth is None:
        return check
    bodies, found = true_bodies(views, truth, folder)
    seen = compare(Room(views, bodies))
    odd = () if failing(seen.agreement, _OF_ROOM) else outliers(seen)
    return replace(
        check, problems=(*problems, *found), agreement=seen.agreement, outliers=tuple(odd)
    )


def array_problems(views: RoomViews, classes: int) -> Iterator[str]:
    """Report values out of range in the views, which are finite (see `Shard.read_room`)."""
    if (views.object_class < 1).any():
        yield f"a class index is outside 1 to {classes - 1}"
    turn = views.world_to_camera[:, :3, :3].astype(np.float64)
    off = np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0)
    flat = np.abs(views.world_to_camera[:, 3] - (0, 0, 0, 1)).max(axis=1, initial=0)
    good = (off < 1e-3) & (flat < 1e-6) & (np.linalg.det(turn) > 0)
    if not good.all():
        yield f"the camera of view {int(np.argmin(good))} is no rotation with a translation"
    K = views.intrinsics
    pinhole = (K[:, (0, 1), (0, 1)] > 0).all(axis=1)
    pinhole &= (K[:, (0, 1, 2, 2, 2), (1, 0, 0, 1, 2)] == (0, 0, 0, 0, 1)).all(axis=1)
    if not pinhole.all():
        yield f"the intrinsics of view {int(np.argmin(pinhole))} are not those of a pinhole camera"
    if not ((views.boxes >= 0) & (views.boxes <= 1)).all():
        yield "a 2D box reaches beyond the image"
    if (views.boxes[~views.visible] != 0).any() or (views.mask_pixels[~views.visible] != 0).any():
        yield "an object that is not visible in a view has a box or pixels there"
    if not views.visible.any(axis=0).all():
        yield f"no view shows object {int(np.argmin(views.visible.any(axis=0)))}"


def mask_problems(views: RoomViews) -> list[str]:
    """Report the first 2D box, pixel count or clear side that disagrees with its mask."""
    assert views.instance_ids is not None
    # All objects get a class other than void, because void masks are not measured.
    seen = observe(views.instance_ids, [VOID + 1] * len(views.object_class) + [VOID])
    visible, boxes, pixels, clear = (
        np.zeros_like(getattr(views, name))
        for name in ("visible", "boxes", "mask_pixels", "sides_clear")
    )
    visible[:, seen.tracked], boxes[:, seen.tracked] = seen.visible, seen.boxes
    pixels[:, seen.tracked], clear[:, seen.tracked] = seen.mask_pixels, seen.sides_clear
    for view, k in np.argwhere(visible != views.visible)[:1]:
        mask = np.argwhere(views.instance_ids[view] == k + 1)
        height, width = np.ptp(mask, axis=0) + 1 if len(mask) else (0, 0)
        said = "visible" if views.visible[view, k] else "not visible"
        size = f"{width} x {height} pixels"
        return [f"view {view}, object {k} is said to be {said}, but its mask is {size}"]
    for wrong, sentence in (
        ((boxes != views.boxes).any(axis=2), "its 2D box does not fit its mask"),
        (pixels != views.mask_pixels, "its mask has {} pixels, mask_pixels says {}"),
        # Objects too narrow to be visible in any view (and, in shards of version 1, void furniture)
        # are 0 in the image but can touch a side: fewer sides may be clear.
        (
            (views.sides_clear & ~clear).any(axis=2),
            "another object touches a side of its box that is said to be clear",
        ),
    ):
        for view, k in np.argwhere(wrong & visible)[:1]:
            counts = pixels[view, k], views.mask_pixels[view, k]
            return [f"view {view}, object {k}: {sentence.format(*counts)}"]
    return []


def truth_problems(views: RoomViews, truth: RoomGroundTruth) -> Iterator[str]:
    """Report ground truth, read and finite, that contradicts itself or the tracked objects."""
    if truth.unoccluded is not None and truth.unoccluded.shape != views.visible.shape:
        came = truth.unoccluded.shape
        yield f"ground truth: unoccluded has shape {came}, expected {views.visible.shape}"
    if not np.array_equal(truth.object_class[: len(views.object_class)], views.object_class):
        yield "ground truth: its first rows are not the tracked objects"
    if (truth.sizes_m < 0).any():
        yield "ground truth: a size is negative"

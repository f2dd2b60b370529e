"""Reads the user's own posed pictures with masks (docs/posed_data.md): a folder is a room."""

import contextlib
import hashlib
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from data_prep.engine.plan import digest, seeded_split
from data_prep.engine.source import Line, RoomTask
from data_prep.readers.frames import choose_frames, room_cameras, shrunk
from data_prep.readers.posed.formats import mask_files, mask_format
from data_prep.readers.posed.masks import (
    TABLES,
    FrameMask,
    MaskFormat,
    read_tracked,
    read_untracked,
)
from data_prep.readers.posed.recording import (
    INSTANCES,
    UP,
    Recording,
    floor_center,
    room_name,
    seems_up,
    upright_cameras,
    why_below_floor,
)
from data_prep.readers.posed.transforms import POSES, pose_files, read_recording
from data_prep.readers.reader import FoundRoom, Reader
from data_prep.readers.rooms import FramedRoom
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import check_file, list_folders

TRACKS = ("given", "auto")


@dataclass(frozen=True, kw_only=True)
class Posed(Reader):
    """Posed pictures: `folder` is one room, or a folder of rooms."""

    name: ClassVar = "posed"
    scene_word: ClassVar = ("room", "a room's folder")
    surveys_all: ClassVar = True
    split_hint: ClassVar = ""
    classes: str
    """Name of the label set."""
    max_side: int | None = None
    poses: str | None = None
    masks: str | None = None
    """Formats of the poses and the masks (`read_formats`); None guesses that of each room."""
    test_share: float = 0.1
    """Share of rooms in the split `test`, which gets at least one of several rooms; 0 puts all
    rooms in `train`."""
    up: str = "auto"
    """Up direction of the poses' world: the axis `z` or `y`, or `cameras`, which estimates it from
    cameras held upright. `auto` is z, as in nerfstudio's files, or `cameras` for COLMAP's."""
    floor_m: float | None = None
    """Height of the floor in rooms whose file has none; None estimates it (`find_floor`)."""
    camera_height_m: float = 1.2
    """Height of the lowest camera above the floor, assumed if the floor cannot be estimated."""
    metres_per_unit: float = 1.0
    """Scale in rooms whose file has none. Poses from pictures alone (COLMAP) have no unit."""
    model: int | None = None
    """Number of one of COLMAP's models; None takes the largest."""
    class_map: tuple[tuple[str, str], ...] = ()
    """Pairs of a name of the masks, as `tidy`, and its class."""
    tracks: str = "given"
    """One of `TRACKS`: ids are `given` for all frames, or `auto` finds objects from masks whose ids
    have no meaning across frames."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.up not in UP:
            raise InputError(f"up is '{self.up}'; choose from {', '.join(UP)}.")
        if self.tracks not in TRACKS:
            raise InputError(f"tracks is '{self.tracks}'; choose from {', '.join(TRACKS)}.")
        for name in ("camera_height_m", "metres_per_unit"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(f"{name} is {getattr(self, name)}; it must be above 0.")
        if self.floor_m is not None and not math.isfinite(self.floor_m):
            raise InputError(f"floor_m is {self.floor_m}; expected a height in metres.")

    @property
    def label_set(self) -> str:
        return self.classes

    def options(self) -> dict[str, Any]:
        label_set(self.label_set)
        if not 0 <= self.test_share < 1:
            raise InputError(
                f"test_share is {self.test_share}; expected a share from 0 to below 1."
            )
        names = ("label_set", "up", "floor_m", "camera_height_m", "metres_per_unit", "max_side",
                 "tracks", "max_views")  # fmt: skip
        formats: dict[str, Any] = {"poses": self.poses, "masks": self.masks}
        if self.model is not None:
            formats["model"] = self.model
        mapped = {"class_map": dict(self.class_map)} if self.class_map else {}
        return {"from": formats, **{name: getattr(self, name) for name in names}, **mapped}

    def fingerprint(self, scenes: list[str]) -> dict[str, Any]:
        """See `Reader.fingerprint`: the contents of files are part of it, so that shards of older
        masks or classes are not reused."""
        paths = {
            (name, Path(os.path.relpath(path, room)).as_posix()): path
            for name, room in self._folders().items()
            if name in scenes
            for path in [
                *pose_files(room, self.poses)[1],
                *(room / table for table in TABLES if (room / table).is_file()),
                *mask_files(room),
                *self._files_of_frames(room),
            ]
        }
        files = {key: _content(path) for key, path in paths.items()}
        return {"test_share": self.test_share, "rooms": digest(repr(sorted(files.items())))}

    def _files_of_frames(self, room: Path) -> Iterator[Path]:
        """Masks that the file of poses names, which may lie anywhere."""
        with contextlib.suppress(InputError):  # the report will have the error
            for frame in read_recording(room, self.poses, self.model).frames:
                yield from (path for path in (frame.instances, frame.known) if path)

    def scenes(self) -> list[str]:
        return [*self._folders()]

    def rooms(self, scene: str) -> dict[str, FoundRoom]:
        """The folder as one room, at the size at which it would be stored."""
        recording, masks = self.open(self._folders()[scene])
        of_frames = masks_of_frames(recording, masks)
        return {scene: FoundRoom(shrunk(of_frames[min(of_frames)].size(), self.max_side))}

    def split_rooms(self, rooms: Mapping[str, str]) -> tuple[dict[str, str], list[Line]]:
        drawn = seeded_split(rooms, self.seed, self.test_share)
        return {name: drawn[name] for name in rooms}, []

    def read(self, task: RoomTask) -> FramedRoom:
        """Read the poses and the masks of a room."""
        folders = self._folders()
        if task.house not in folders:
            raise InputError(f"{self.folder} no longer has this room; restore its folder.")
        recording, masks = self.open(folders[task.house])
        of_frames = masks_of_frames(recording, masks)
        unused = masks.unused(recording.frames)
        chosen, notes = choose_frames(
            str(recording.path),
            np.stack([frame.camera_to_world for frame in recording.frames]),
            of_frames.keys(), self.max_views, mask="mask", hint="",
            names=[frame.name for frame in recording.frames],
        )  # fmt: skip
        frames = [recording.frames[k] for k in chosen]
        upright, turn = upright_cameras(recording, chosen, self.up, self.metres_per_unit)
        try:
            size = of_frames[min(of_frames)].size()
            if self.tracks == "auto" or not masks.tracked:
                made = read_untracked(masks, frames, size, self.max_side, room_cameras(upright))
            else:
                made = read_tracked(masks, frames, size, self.max_side)
        except InputError as error:
            raise InputError(f"{recording.path}: {str(error).removesuffix('.')}.") from None
        return FramedRoom(
            **made | {"notes": (*recording.notes, *notes, *unused, *made["notes"])},
            where=str(recording.path),
            camera_to_world=upright,
            may_err=True,
            world_from_file=turn,
            poses_file=recording.path.relative_to(recording.folder).as_posix(),
            floor_y=recording.floor_m if recording.floor_m is not None else self.floor_m,
            assumed_camera_m=self.camera_height_m,
            center_m=floor_center(recording, turn),
            why_below=f": {why_below_floor(recording, turn)}",
        )

    def _folders(self) -> dict[str, Path]:
        """Folder of each room by the room's name."""
        return {room_name(room): room for room in find_rooms(self.folder, self.poses)}

    def open(self, room: Path) -> tuple[Recording, MaskFormat]:
        """Poses and masks of a room's folder."""
        recording = read_recording(room, self.poses, self.model)
        masks = mask_format(room, self.masks)(room, self.label_set)
        masks.class_map = dict(self.class_map)
        return recording, masks

    def found(self) -> list[str]:
        """Sentences that name the tools whose files were found, for formats that were guessed."""
        if self.poses and self.masks:
            return []
        count: Counter[tuple[str, type[MaskFormat]]] = Counter()
        for room in self._folders().values():
            with contextlib.suppress(InputError):  # the report will have the error
                poses, files = pose_files(room, self.poses)
                masks = mask_format(room, self.masks)
                if files:
                    count[poses, masks] += 1
        return [
            f"{number} room{'s' * (number > 1)} with poses of {POSES[poses]} and masks of "
            f"{masks.title}, as with --from {poses} --from {masks.name}."
            for (poses, masks), number in count.items()
        ]

    def assumptions(self) -> list[str]:
        """Sentences on values that the files lack and that are assumed, printed first."""
        recordings: list[Recording] = []
        untracked: list[str] = []
        for room in self._folders().values():
            try:
                recording, masks = self.open(room)
                untracked += [] if masks.tracked else [masks.title]
            except InputError:
                continue  # the report will have the error
            recordings.append(recording)
        rooms = f"of {len(recordings)} rooms"
        sentences = []
        if single := sum(len(recording.frames) < 2 for recording in recordings):
            sentences.append(
                f"{single} {rooms} have only one frame, which shows no depth: objects are lifted "
                "to 3D from at least two views, better twenty."
            )
        if untracked and self.tracks != "auto":
            sentences.append(
                f"In {len(untracked)} {rooms} ids belong to single images ({untracked[0]}): "
                "objects are found from poses, masks and classes, as with --tracks auto."
            )
        if several := [recording for recording in recordings if recording.notes]:
            sentences.append(
                f"In {len(several)} {rooms} a part of the poses is unused: in "
                f"{several[0].folder.name}, {several[0].notes[0]}."
            )
        unknown = sum(recording.floor_m is None for recording in recordings)
        if unknown and self.floor_m is None:
            sentences.append(
                f"{unknown} {rooms} give no floor_m: the floor is estimated from the lowest pieces "
                "(median error 1 to 2 cm in our tests), or else assumed "
                f"{self.camera_height_m:g} m below the lowest camera (error 21 cm); report.csv "
                "says which. Measure the floor and give floor_m or --floor-m, or at least the "
                "lowest camera's height with --camera-height-m."
            )
        unknown = sum(recording.metres_per_unit is None for recording in recordings)
        if unknown and self.metres_per_unit == 1:
            sentences.append(
                f"{unknown} {rooms} give no metres_per_unit: poses are assumed to be in metres, "
                "which COLMAP's are not."
            )
        stated = [recording for recording in recordings if recording.up != "cameras"]
        if (lying := len(recordings) - len(stated)) and self.up == "auto":
            sentences.append(
                f"{lying} {rooms} do not state the up direction: it is estimated from the cameras, "
                "as if they were held upright. If they roll by 5 degrees, the median error is 1.3 "
                "degrees, and floors rise by 5 cm in 2 m. Turn the poses until an axis points up, "
                "and name it with --up."
            )
        for taken, axis in (("z", "y"), ("y", "z")):
            if other := sum(
                taken == (recording.up if self.up == "auto" else self.up)
                and seems_up(recording) == axis
                for recording in stated
            ):
                sentences.append(
                    f"In {other} {rooms} the tops of the pictures point along {axis}, but {taken} "
                    f"is taken as up; should it be --up {axis}?"
                )
        return sentences


def masks_of_frames(recording: Recording, masks: MaskFormat) -> dict[int, FrameMask]:
    """Masks of the frames that have any, by the frame's place in the file."""
    found = {k: masks.of(frame) for k, frame in enumerate(recording.frames)}
    of_frames = {k: mask for k, mask in found.items() if mask is not None}
    if not of_frames:
        raise InputError(
            f"{recording.path}: none of its {len(recording.frames)} frames has a mask; expected "
            f"{masks.wanted(recording.frames[0])}."
        )
    return of_frames


def _content(path: Path) -> str:
    """Hash of a file; empty if it cannot be read."""
    try:
        check_file(path)
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (InputError, OSError):
        return ""


def find_rooms(folder: Path, poses: str | None = None) -> list[Path]:
    """Find rooms: the folder itself if it holds poses (`pose_files`), else its sub-folders, sorted.

    Sub-folders with masks but no poses are included, so that the report mentions them.
    """
    if not folder.is_dir():
        raise InputError(
            f"No folder at {folder}; prep-posed reads a folder of rooms, unpacked from a .zip or "
            ".r3d file."
        )
    if pose_files(folder, poses)[1]:
        return [folder]
    own = list_folders(folder)
    found = [path for path in own if pose_files(path, poses)[1] or (path / INSTANCES).is_dir()]
    if found:  # otherwise those with masks are parts of a room without poses
        found = [path for path in own if path in found or mask_files(path)]
    if not found:
        tools = POSES.values() if poses is None else [POSES[poses]]
        raise InputError(
            f"{folder} holds no poses of {', '.join(tools)}, and none of its sub-folders does "
            "(unpack .zip and .r3d files)."
        )
    return found

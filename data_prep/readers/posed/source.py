"""Source for folders of posed pictures; a folder with poses and masks is a room."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from data_prep.engine.plan import (
    digest,
    digest_of_files,
    house_may_match,
    of_one_size,
    seeded_split,
    select,
)
from data_prep.engine.source import Line, PreparedRoom, RoomTask, Survey, sentence_of
from data_prep.engine.workers import Run
from data_prep.readers.posed.cameras import seems_up
from data_prep.readers.posed.formats import Formats, mask_files
from data_prep.readers.posed.labels import TABLES
from data_prep.readers.posed.mask_format import MaskFormat
from data_prep.readers.posed.recording import INSTANCES, Recording, room_name
from data_prep.readers.posed.transforms import POSES, pose_files, read_recording
from data_prep.readers.posed.views import PosedSettings, prepare_posed, stored_size
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.render.offscreen import Renderer


@dataclass(frozen=True)
class PosedSource:
    """The `Source` (data_prep/engine/source.py) behind `prep-posed`."""

    name: ClassVar = "posed"
    room_type: ClassVar = "posed"
    draws: ClassVar = False
    folder: Path
    """One room, or a folder of rooms."""
    label_set: str
    posed_settings: PosedSettings = field(default_factory=PosedSettings)
    test_share: float = 0.1
    """Share of rooms in the split `test`, which gets at least one of several rooms; 0 puts all
    rooms in `train`."""
    seed: int = 0
    only: str | None = None
    formats: Formats = field(default_factory=Formats)
    """The tools that wrote the poses and the masks."""

    def settings(self, only: str | None) -> dict[str, Any]:
        """See `Source.settings`.

        The names and sizes of files are part of the settings, so that shards of older masks or
        classes are not reused.
        """
        label_set(self.label_set)
        if not 0 <= self.test_share < 1:
            raise InputError(
                f"test_share is {self.test_share}; expected a share from 0 to below 1."
            )
        rooms = [path for path in self._rooms() if house_may_match(only, room_name(path))]
        if not rooms:
            raise InputError(f"{self.folder} has no room '{only}' (--only takes a room's folder).")
        files = {
            room_name(room): digest_of_files(
                pose_files(room, self.formats.poses)[1]
                + [room / name for name in TABLES if (room / name).is_file()]
                + mask_files(room)
            )
            for room in rooms
        }
        return {
            "recipe": {
                "label_set": self.label_set,
                "from": asdict(self.formats),
                **asdict(self.posed_settings),
            },
            "seed": self.seed,
            "test_share": self.test_share,
            "rooms": digest(repr(sorted(files.items()))),
        }

    def survey(self, run: Run) -> Survey:
        """Read every room's poses and the size of its masks."""
        rooms = self._rooms()
        sizes: dict[str, tuple[int, int]] = {}
        left_out: list[Line] = []
        looked = run(_look, [(self, room) for room in rooms], "reading rooms")
        for room, found in zip(rooms, looked, strict=True):
            name = room_name(room)
            if isinstance(found, str):
                left_out.append(Line(name, name, "failed", reason=found))
            else:
                sizes[name] = found
        names, others = of_one_size(sizes)
        left_out += others
        split_of = seeded_split(names, self.seed, self.test_share)
        tasks = tuple(RoomTask(name, name, split_of[name]) for name in names)
        survey = Survey(tasks, tuple(left_out))
        return select(survey, self.only, f"{self.folder} can be prepared")

    def prepare(self, task: RoomTask, renderer: Renderer | None) -> PreparedRoom | Line:
        """Read one room and label its views."""
        folders = {room_name(room): room for room in self._rooms()}
        if task.house not in folders:
            raise InputError(f"{self.folder} no longer has this room; restore its folder.")
        recording, masks = self.open(folders[task.house])
        made = prepare_posed(recording, masks, self.posed_settings)
        if made is None:
            why = f"none of its {len(recording.frames)} frames shows any object"
            return Line(task.room_id, task.house, "filtered", "no_view", why)
        return made

    def _rooms(self) -> list[Path]:
        return find_rooms(self.folder, self.formats.poses)

    def open(self, room: Path) -> tuple[Recording, MaskFormat]:
        """Poses and masks of a room's folder."""
        recording = read_recording(room, self.formats.poses)
        return recording, self.formats.masks_of(room, self.label_set)

    def found(self) -> list[str]:
        """Sentences that name the tools whose files were found, for formats that were guessed."""
        return self.formats.found(self._rooms())

    def assumptions(self) -> list[str]:
        """Sentences on values that the files lack and that are assumed, printed first."""
        recordings: list[Recording] = []
        untracked: list[str] = []
        for room in self._rooms():
            try:
                recording, masks = self.open(room)
                untracked += [] if masks.tracked else [masks.title]
            except InputError:
                continue  # the report will have the error
            recordings.append(recording)
        settings, count = self.posed_settings, len(recordings)
        sentences = []
        if single := sum(len(recording.frames) < 2 for recording in recordings):
            sentences.append(
                f"{single} of {count} rooms have only one frame, which shows no depth: objects are "
                "lifted to 3D from at least two views, better twenty."
            )
        if untracked and settings.tracks != "auto":
            sentences.append(
                f"In {len(untracked)} of {count} rooms ids belong to single images "
                f"({untracked[0]}): objects are found from poses, masks and classes, as with "
                "--tracks auto."
            )
        unknown = sum(recording.floor_m is None for recording in recordings)
        if unknown and settings.floor_m is None:
            sentences.append(
                f"{unknown} of {count} rooms give no floor_m: the floor is estimated from the "
                "lowest pieces (median error 1 to 2 cm in our tests), or else assumed "
                f"{settings.camera_height_m:g} m below the lowest camera (error 21 cm); report.csv "
                "says which. Measure the floor and give floor_m or --floor-m, or at least the "
                "lowest camera's height with --camera-height-m."
            )
        unknown = sum(recording.metres_per_unit is None for recording in recordings)
        if unknown and settings.metres_per_unit == 1:
            sentences.append(
                f"{unknown} of {count} rooms give no metres_per_unit: poses are assumed to be in "
                "metres, which COLMAP's are not."
            )
        lying = sum(recording.up == "cameras" for recording in recordings)
        if lying and settings.up == "auto":
            sentences.append(
                f"{lying} of {count} rooms do not state the up direction: it is estimated from the "
                "cameras, as if they were held upright. If they roll by 5 degrees, the median "
                "error is 1.3 degrees, and floors rise by 5 cm in 2 m. Turn the poses until an "
                "axis points up, and name it with --up."
            )
        for taken, axis in (("z", "y"), ("y", "z")):
            tops = [
                seems_up(recording)
                for recording in recordings
                if recording.up != "cameras"
                and taken == (recording.up if settings.up == "auto" else settings.up)
            ]
            if other := tops.count(axis):
                sentences.append(
                    f"In {other} of {count} rooms the tops of the pictures point along {axis}, but "
                    f"{taken} is taken as up; should it be --up {axis}?"
                )
        return sentences


def find_rooms(folder: Path, poses: str | None = None) -> list[Path]:
    """Find rooms: the folder itself if it holds poses (`pose_files`), else its sub-folders, sorted.

    Sub-folders with `instances/` but no poses are included, so that the report mentions them.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(
            f"No folder at {folder}; prep-posed reads a folder of rooms, unpacked from a .zip or "
            ".r3d file."
        )
    if pose_files(folder, poses)[1]:
        return [folder]
    found = [
        path
        for path in sorted(folder.iterdir())
        if path.is_dir() and (pose_files(path, poses)[1] or (path / INSTANCES).is_dir())
    ]
    if not found:
        tools = POSES.values() if poses is None else [POSES[poses]]
        raise InputError(
            f"{folder} holds no poses of {', '.join(tools)}, and none of its sub-folders does "
            "(unpack .zip and .r3d files)."
        )
    return found


def _look(source: PosedSource, room: Path) -> tuple[int, int] | str:
    """Image size at which a room would be stored, or the reason why it cannot be prepared."""
    try:
        return stored_size(*source.open(room), source.posed_settings)
    except Exception as error:
        return sentence_of(error)

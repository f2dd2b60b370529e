"""The source of every data set and capture: it lists rooms, splits them, and prepares each."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from data_prep.engine.plan import (
    digest,
    house_may_match,
    of_one_size,
    read_splits,
    seeded_split,
    select,
)
from data_prep.engine.source import (
    Line,
    PreparedRoom,
    RoomTask,
    Survey,
    sentence_of,
)
from data_prep.readers.annotations import LABEL_SET
from data_prep.readers.rooms import FramedRoom, prepare_room
from sceneprior.core.errors import InputError
from sceneprior.core.parallel import run_tasks
from sceneprior.core.shards import SPLITS
from sceneprior.render.offscreen import Renderer


@dataclass(frozen=True)
class FoundRoom:
    """A room found in a scene's folder."""

    image_size: tuple[int, int]
    """(height, width) of its images of ids, before they are shrunk."""
    extra: dict[str, Any] = field(default_factory=dict)
    """JSON values that reading the room needs (`RoomTask.extra`)."""


@dataclass(frozen=True, kw_only=True)
class Reader(ABC):
    """Reads the files of one data set: a `Source` (data_prep/engine/source.py).

    A scene is what is read as one: a folder with one room or several.
    """

    name: ClassVar[str]
    """Name of the data set in `index.json`."""
    draws: ClassVar = False
    scene_word: ClassVar = ("scene", "a scene, SCENE/ROOM or a room id")
    """The data set's word for a scene, and what `--only` takes."""
    surveys_all: ClassVar = False
    """True if the rooms to prepare depend on all scenes, even with `--only`."""
    folder: Path = field(kw_only=False)
    """The folder of scenes."""
    splits: Path | None = None
    """CSV with two columns: a room or scene, and its split. None takes the data set's official
    split or, without one, splits the scenes 9:1 by the seed."""
    max_side: int | None = 480
    """Maximum side of stored images in pixels."""
    max_views: int = 100
    """Maximum number of views per room; more frames are thinned evenly (paper: 100)."""
    seed: int = 0
    only: str | None = None

    def __post_init__(self) -> None:
        for name in ("max_side", "max_views"):
            self._check_positive(name)

    def _check_positive(self, name: str) -> None:
        value = getattr(self, name)
        if value is not None and value < 1:
            raise InputError(f"{name} is {value}; expected at least 1.")

    @property
    def label_set(self) -> str:
        """Name of the label set."""
        return LABEL_SET

    @property
    def room_type(self) -> str:
        """Type of the rooms; also in the shards' names."""
        return self.name

    @abstractmethod
    def scenes(self) -> list[str]:
        """Sorted names of the scenes."""

    @abstractmethod
    def rooms(self, scene: str) -> dict[str, FoundRoom]:
        """Rooms of a scene by id, which is `<scene>` or `<scene>_<room>`."""

    @abstractmethod
    def read(self, task: RoomTask) -> FramedRoom:
        """Read one room with at most `max_views` views, its images no larger than `max_side`."""

    def options(self) -> dict[str, Any]:
        """Settings that the shards depend on, for `index.json`; checks files shared by scenes."""
        return {"max_side": self.max_side, "max_views": self.max_views}

    def fingerprint(self, scenes: list[str]) -> dict[str, Any]:
        """Further settings that the shards depend on: splits, and files as digests."""
        return {
            "splits": digest(repr(read_splits(self.splits))) if self.splits else None,
            # Only names, so that a damaged scene can be downloaded again and retried.
            "scenes": digest("\n".join(scenes)),
        }

    @property
    def official(self) -> tuple[str, dict[str, int]] | None:
        """See `Source.official`."""
        return None

    def official_split(self, scene: str) -> str | None:
        """Split of a scene, if the data set states it in the scene's name."""
        return None

    def split_rooms(self, rooms: Mapping[str, str]) -> tuple[dict[str, str], list[Line]]:
        """Split of rooms, given the scene of each, and lines about those that are in none.

        All rooms of a scene are in the same split, unless the file `splits` says otherwise.
        """
        listed = read_splits(self.splits) if self.splits else {}
        drawn = seeded_split(self.scenes(), self.seed)
        split_of: dict[str, str] = {}
        left_out = []
        for room_id, scene in rooms.items():
            bare = room_id.removeprefix(f"{scene}_")
            split = listed.get(room_id, listed.get(scene, listed.get(bare)))
            if not self.splits:
                split = self.official_split(scene) or drawn[scene]
            if split in SPLITS:
                split_of[room_id] = split
            else:
                left_out.append(Line(room_id, scene, "filtered", "split", "it is in no split"))
        return split_of, left_out

    @property
    def split_hint(self) -> str:
        """Advice if no room is in `train`; "" if that cannot be."""
        return str(self.splits or "the split, or give one with --splits")

    def settings(self, only: str | None) -> dict[str, Any]:
        return {"recipe": self.options(), "seed": self.seed, **self.fingerprint(self._chosen(only))}

    def survey(self) -> Survey:
        """List the rooms of every scene."""
        scenes = self._chosen(None if self.surveys_all else self.only)
        found: dict[str, FoundRoom] = {}
        scene_of: dict[str, str] = {}
        left_out: list[Line] = []
        word = self.scene_word[0]
        looked = run_tasks(_look, {scene: (self, scene) for scene in scenes}, f"reading {word}s")
        for scene, rooms in zip(scenes, looked, strict=True):
            if isinstance(rooms, str):
                left_out.append(Line(scene, scene, "failed", reason=rooms))
                continue
            found |= rooms
            scene_of |= dict.fromkeys(rooms, scene)
        sizes = {room_id: room.image_size for room_id, room in found.items()}
        usual, others = of_one_size(sizes, scene_of)
        split_of, in_none = self.split_rooms({room_id: scene_of[room_id] for room_id in usual})
        tasks = tuple(
            RoomTask(room_id, scene_of[room_id], split, extra=found[room_id].extra)
            for room_id, split in split_of.items()
        )
        survey = Survey(tasks, (*left_out, *others, *in_none))
        return select(survey, self.only, f"{self.folder} can be prepared", self.split_hint)

    def prepare(self, task: RoomTask, renderer: Renderer | None) -> PreparedRoom | Line:
        """Read one room and label its views."""
        return prepare_room(task, self.read(task))

    def _chosen(self, only: str | None) -> list[str]:
        chosen = [scene for scene in self.scenes() if house_may_match(only, scene)]
        if not chosen:
            word, taken = self.scene_word
            raise InputError(f"{self.folder} has no {word} '{only}' (--only takes {taken}).")
        return chosen


def _look(reader: Reader, scene: str) -> dict[str, FoundRoom] | str:
    """Rooms of a scene, or the reason why it cannot be read."""
    try:
        return reader.rooms(scene)
    except Exception as error:
        return sentence_of(error)


def by_number(paths: Sequence[Path]) -> list[Path]:
    """Sort paths that are named by numbers: 2 before 10."""
    return sorted(paths, key=lambda path: (len(path.name), path.name))

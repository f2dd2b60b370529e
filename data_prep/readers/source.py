"""The `Source` of all public data sets, on top of a reader for each data set."""

from collections.abc import Callable
from dataclasses import dataclass
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
    SPLITS,
    Line,
    PreparedRoom,
    RoomTask,
    Survey,
    sentence_of,
)
from data_prep.engine.workers import Run
from data_prep.front.recipe import load_recipe
from data_prep.readers.blenderproc import BlenderProc
from data_prep.readers.hypersim import Hypersim
from data_prep.readers.rooms import FoundRoom, Reader, prepare_room
from data_prep.readers.scannetpp import ScanNetPP
from data_prep.readers.structured3d import Structured3D
from sceneprior.core.errors import InputError
from sceneprior.render.offscreen import Renderer

_BLENDERPROC = "blenderproc"
_READERS: dict[str, Callable[[Path], Reader]] = {
    "hypersim": Hypersim, "structured3d": Structured3D, "scannetpp": ScanNetPP,
}  # fmt: skip
DATA_SETS = (_BLENDERPROC, *_READERS)


def open_reader(name: str, folder: Path, recipe: str | None = None) -> Reader:
    """Reader of a data set; `recipe` selects rooms and classes of 3D-FRONT (None: bedroom)."""
    if not folder.is_dir():
        raise InputError(f"No folder at {folder}; expected the scenes of {name}.")
    if name not in DATA_SETS:
        raise InputError(f"No data set is called '{name}'; choose from {', '.join(DATA_SETS)}.")
    if recipe is not None and name != _BLENDERPROC:
        raise InputError(
            f"--recipe selects rooms of 3D-FRONT, so it is not for {name}; leave it out."
        )
    reader: Reader
    if name == _BLENDERPROC:
        reader = BlenderProc(folder, load_recipe(recipe or "bedroom"))
    else:
        reader = _READERS[name](folder)
    if not reader.scenes():
        raise InputError(f"{folder} holds no scene of {name}; docs/public_data.md shows the files.")
    return reader


@dataclass(frozen=True)
class PublicSource:
    """The `Source` (data_prep/engine/source.py) behind `prep-dataset`."""

    draws: ClassVar = False
    reader: Reader
    splits: Path | None = None
    """CSV with two columns: a room or scene, and its split. None takes the data set's official
    split or, without one, splits the scenes 9:1 by the seed."""
    max_side: int | None = 480
    """Maximum side of stored images in pixels."""
    max_views: int = 100
    """Maximum number of views per room; more frames are thinned evenly (paper: 100)."""
    seed: int = 0
    only: str | None = None

    @property
    def name(self) -> str:
        return self.reader.name

    @property
    def label_set(self) -> str:
        return self.reader.label_set

    @property
    def room_type(self) -> str:
        return self.reader.room_type

    def settings(self, only: str | None) -> dict[str, Any]:
        """See `Source.settings`."""
        for name in ("max_side", "max_views"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"{name} is {value}; expected at least 1.")
        sizes = {"max_side": self.max_side, "max_views": self.max_views}
        return {
            "recipe": {**sizes, **self.reader.settings()},
            "seed": self.seed,
            "splits": digest(repr(read_splits(self.splits))) if self.splits else None,
            # Only names, so that a damaged scene can be downloaded again and retried.
            "scenes": digest("\n".join(self._scenes(only))),
        }

    def survey(self, run: Run) -> Survey:
        """List the rooms of every scene."""
        scenes = self._scenes(self.only)
        sizes: dict[str, tuple[int, int]] = {}
        rooms: dict[str, tuple[str, FoundRoom]] = {}
        left_out: list[Line] = []
        looked = run(_look, [(self.reader, scene) for scene in scenes], "reading scenes")
        for scene, found in zip(scenes, looked, strict=True):
            if isinstance(found, str):
                left_out.append(Line(scene, scene, "failed", reason=found))
                continue
            for room_id, room in found.items():
                rooms[room_id] = scene, room
                sizes[room_id] = room.image_size
        usual, others = of_one_size(
            sizes, {room_id: scene for room_id, (scene, _) in rooms.items()}
        )
        left_out += others
        listed = read_splits(self.splits) if self.splits else {}
        drawn = seeded_split(self.reader.scenes(), self.seed)
        tasks = []
        for room_id in usual:
            scene, room = rooms[room_id]
            bare = room_id.removeprefix(f"{scene}_")
            split = listed.get(room_id, listed.get(scene, listed.get(bare)))
            if not self.splits:
                split = self.reader.official_split(scene) or drawn[scene]
            if split in SPLITS:
                tasks.append(RoomTask(room_id, scene, split, extra=room.extra))
            else:
                left_out.append(Line(room_id, scene, "filtered", "split", "it is in no split"))
        where = f"{self.reader.folder} can be prepared"
        hint = str(self.splits or "the split, or give one with --splits")
        return select(Survey(tuple(tasks), tuple(left_out)), self.only, where, hint)

    def prepare(self, task: RoomTask, renderer: Renderer | None) -> PreparedRoom | Line:
        """Read one room and label its views."""
        room = self.reader.read(task, self.max_side, self.max_views)
        made = prepare_room(task.room_id, room, self.label_set)
        if made is None:
            why = f"none of its {len(room.ids)} views shows any object"
            return Line(task.room_id, task.house, "filtered", "no_view", why)
        return made

    def _scenes(self, only: str | None) -> list[str]:
        chosen = [scene for scene in self.reader.scenes() if house_may_match(only, scene)]
        if not chosen:
            raise InputError(
                f"{self.reader.folder} has no scene '{only}' (--only takes a scene, SCENE/ROOM or "
                "a room id)."
            )
        return chosen


def _look(reader: Reader, scene: str) -> dict[str, FoundRoom] | str:
    """Rooms of a scene, or the reason why it cannot be read."""
    try:
        return reader.rooms(scene)
    except Exception as error:
        return sentence_of(error)

"""Source for 3D-FRONT and homes in its format: surveys house by house, renders room by room."""

import contextlib
import functools
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from data_prep.engine.plan import (
    digest,
    house_may_match,
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
from data_prep.front.furnished import ModelBank, Room
from data_prep.front.houses import House, house_files, parse_house, read_house
from data_prep.front.recipe import Recipe, broken_rule, outside_floor, unknown_categories
from data_prep.front.views import prepare_room, view_counts
from sceneprior.core.errors import InputError
from sceneprior.core.files import file_stamp, read_text
from sceneprior.core.furniture import model_categories, model_info_path
from sceneprior.core.parallel import run_tasks
from sceneprior.core.shards import SPLITS
from sceneprior.render.offscreen import Renderer

_HOUSES_PER_TASK = 8


@dataclass(frozen=True)
class FrontSource:
    """The `Source` (data_prep/engine/source.py) behind `prep-front`."""

    name: ClassVar = "3d-front"
    draws: ClassVar = True
    official: ClassVar = None
    front: Path
    future: Path
    recipe: Recipe
    splits: Path | None = None
    """CSV of `room id,split`; None splits 8:1:1 into train, val and test, seeded."""
    seed: int = 0
    only: str | None = None

    @property
    def label_set(self) -> str:
        return self.recipe.label_set

    @property
    def room_type(self) -> str:
        return self.recipe.name

    def settings(self, only: str | None) -> dict[str, Any]:
        """See `Source.settings`."""
        info = model_info_path(Path(self.future))
        model_categories(Path(self.future))  # reports a bad list here, not once per house
        if self.splits is not None:
            read_splits(self.splits)
        recipe = self.recipe.model_dump()
        for key in ("invalid_rooms", "invalid_models"):  # hashed, as there may be thousands
            recipe[key] = digest("\n".join(recipe[key])) if recipe[key] else None
        return {
            "recipe": recipe,
            "seed": self.seed,
            "splits": None if self.splits is None else digest(read_text(self.splits)),
            # Sizes: quick to find, and enough to notice another release.
            "houses": {path.stem: file_stamp(path)[1] for path in self._houses(only)},
            "models": file_stamp(info)[1],
        }

    def survey(self) -> Survey:
        """Read every house once, without meshes, and list the rooms to draw."""
        files = self._houses(self.only)
        found: list[tuple[str, str, int]] = []
        left_out: list[Line] = []
        starts = range(0, len(files), _HOUSES_PER_TASK)
        tasks = {f"houses from {files[i]}": (self, files[i : i + _HOUSES_PER_TASK]) for i in starts}
        for rooms, lost in run_tasks(_survey_houses, tasks, "reading houses"):
            found += rooms
            left_out += lost
        if not found and not left_out:
            kinds = " or ".join(self.recipe.room_types or ("any type",))
            types: Counter[str] = Counter()
            for path in files:
                with contextlib.suppress(InputError):  # the report, if any, has the failure
                    entries = [room for room in parse_house(path).rooms if isinstance(room, dict)]
                    types.update(str(entry.get("type") or "?") for entry in entries)
            said = ", ".join(f"{name} ({count})" for name, count in types.most_common())
            raise InputError(
                f"No room of {self.front} is of a type that {self.recipe.name} selects ({kinds}); "
                f"the folder has {said or 'none that could be read'}."
            )
        if self.splits is None:
            room_ids = [room_id for room_id, _, _ in found]
            split_of_id = seeded_split(room_ids, self.seed, val_share=0.1)
        else:
            split_of_id = read_splits(self.splits)
        rooms_to_draw = []
        for room_id, house, views in found:
            bare = room_id.removeprefix(f"{house}_")
            split = split_of_id.get(room_id, split_of_id.get(bare, ""))
            if split in SPLITS:
                rooms_to_draw.append(RoomTask(room_id, house, split, views))
            else:
                left_out.append(Line(room_id, house, "filtered", "split", "it is in no split"))
        where = f"{self.front} passes the recipe {self.recipe.name}"
        survey = Survey(tuple(rooms_to_draw), tuple(left_out))
        return select(survey, self.only, where, str(self.splits or ""))

    def prepare(self, task: RoomTask, renderer: Renderer | None) -> PreparedRoom | Line:
        """Read one room with its meshes and draw its views."""
        assert renderer is not None
        path = Path(self.front) / f"{task.house}.json"
        house = _parsed(path, file_stamp(path))
        read = read_house(house, self.bank, self.recipe, lambda its_id, _: its_id == task.room_id)
        if not read.rooms:
            why = [line.reason for line in read.left_out] or ["it is no longer in the house file"]
            return Line(task.room_id, task.house, "failed", reason=why[0])
        room = read.rooms[0]
        # The rules are checked again with meshes: unreadable models may leave too little furniture.
        broken = broken_rule(room, self.recipe)
        made = None
        if broken is None:
            made = prepare_room(room, task.views, self.recipe, self.seed, renderer)
            broken = "no_view", "no view shows any object"
        if made is None:
            return _filtered(room, task.house, self.recipe, *broken)
        pieces = [piece for piece in room.furniture if piece.label != "void"]
        models = {piece.model_id: piece.model for piece in pieces}
        notes = room.notes
        if outside := outside_floor(room):
            notes += (f"{outside} of {len(room.furniture)} pieces stand outside of the floor",)
        return PreparedRoom(*made, models, notes, unknown_categories(room, self.recipe))

    @property
    def bank(self) -> ModelBank:
        """The furniture models."""
        folder = Path(self.future)
        return _bank(folder, file_stamp(model_info_path(folder)))

    def _houses(self, only: str | None) -> list[Path]:
        chosen = [path for path in house_files(self.front) if house_may_match(only, path.stem)]
        if not chosen:
            house, slash, _ = (only or "").partition("/")
            room = "" if slash else f" A room is named with its house: --only HOUSE/{house}."
            raise InputError(
                f"{self.front} has no house '{house}' (--only takes HOUSE, HOUSE/ROOM or ID).{room}"
            )
        return chosen


# Models and houses are cached from room to room within a process. The stamps make workers that
# outlive the job, such as those of a cluster, reread a repaired file.
@functools.lru_cache(maxsize=1)
def _bank(future: Path, stamp: tuple[int, int]) -> ModelBank:
    return ModelBank(future)


@functools.lru_cache(maxsize=1)
def _parsed(path: Path, stamp: tuple[int, int]) -> House:
    return parse_house(path)


def _filtered(room: Room, house: str, recipe: Recipe, rule: str, reason: str) -> Line:
    return Line(
        room.room_id, house, "filtered", rule, reason, notes=[*room.notes],
        unknown_categories=unknown_categories(room, recipe),
    )  # fmt: skip


def _survey_houses(
    source: FrontSource, files: list[Path]
) -> tuple[list[tuple[str, str, int]], list[Line]]:
    """Read houses; returns (room id, house, views) of the rooms to draw, and the rooms left out."""
    recipe = source.recipe
    found: list[tuple[str, str, int]] = []
    left_out: list[Line] = []
    for path in files:
        house = path.stem
        try:
            read = read_house(
                parse_house(path), source.bank, recipe, lambda _, kind: recipe.of_type(kind),
                load_models=False,
            )  # fmt: skip
        except Exception as error:
            left_out.append(Line(house, house, "failed", reason=sentence_of(error)))
            continue
        # Unusable rooms come first.
        left_out += sorted(read.left_out, key=lambda line: line.status == "filtered")
        good = []
        for room in read.rooms:
            broken = broken_rule(room, recipe)
            if broken is None:
                good.append(room)
            else:
                left_out.append(_filtered(room, house, recipe, *broken))
        counts = view_counts([float(room.floor.area) for room in good], recipe.views)
        found += [(room.room_id, house, views) for room, views in zip(good, counts, strict=True)]
    return found, left_out

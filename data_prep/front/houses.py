"""Reads the houses of 3D-FRONT: their JSON files, and the rooms in them with all their quirks."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from data_prep.engine.source import Line
from data_prep.front.furnished import Furniture, ModelBank, Room, unit_of
from data_prep.front.geometry import (
    floor_of,
    height_of,
    in_frame,
    placement_of,
    room_frame,
    surface_of,
)
from data_prep.front.recipe import Recipe
from sceneprior.core.checked import shown
from sceneprior.core.errors import InputError
from sceneprior.core.files import is_name, list_files, read_json
from sceneprior.core.furniture import MODEL_FILE, tidy_category
from sceneprior.core.scene import Mesh

_NO_MESH = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
_FLAT = 1e-9
STUFF_OF_MESH = {
    "Floor": "floor", "WallInner": "wall", "Baseboard": "wall", "Customized_wainscot": "wall",
    "CustomizedFeatureWall": "wall", "CustomizedBackgroundModel": "wall",
    "ExtrusionCustomizedBackgroundWall": "wall", "Door": "door", "Window": "window",
    "BayWindow": "window", "Ceiling": "ceiling", "CustomizedCeiling": "ceiling",
    "SmartCustomizedCeiling": "ceiling", "ExtrusionCustomizedCeilingModel": "ceiling",
}  # fmt: skip
"""Class in `STUFF` of each mesh type that is visible from inside a room."""


@dataclass(frozen=True)
class House:
    """A parsed house file, before its rooms are read."""

    name: str
    """`<house uid>`, from the file's name."""
    rooms: list[Any]
    """Entries of `scene.room`, unchecked."""
    furniture: dict[str, dict[str, Any]]
    meshes: dict[str, dict[str, Any]]
    """Furniture and mesh entries by uid."""


def house_files(folder: Path) -> list[Path]:
    """The house files of a 3D-FRONT folder, sorted; raises InputError if it holds none."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(
            f"No folder at {folder}; --front names the folder of 3D-FRONT's house JSONs."
        )
    if (folder / "model_info.json").exists():
        raise InputError(f"{folder} holds furniture models, not houses; give it as --future.")
    inside = folder / "3D-FRONT"
    files = [] if inside.is_dir() else list_files(folder, "*.json")
    if not files:
        hint = f"; did you mean {inside}?" if inside.is_dir() else "."
        raise InputError(f"{folder} holds no house JSONs (<uid>.json){hint}")
    return files


def parse_house(path: Path) -> House:
    """Read the JSON of one house; raises InputError if the file is not a house."""
    data = read_json(path, is_text=False)  # rooms with ids that are none are told one by one
    lists: dict[str, list[Any]] = {}
    for key in ("furniture", "mesh", "scene.room"):
        found = data
        for part in key.split("."):
            found = found.get(part) if isinstance(found, dict) else None
        if not isinstance(found, list):
            raise InputError(f"{path.name} is not a 3D-FRONT house: it has no list '{key}'.")
        lists[key] = found
    return House(
        path.stem, lists["scene.room"], _by_uid(lists["furniture"]), _by_uid(lists["mesh"])
    )


def is_valid(entry: dict[str, Any]) -> bool:
    """Test whether 3D-FRONT marks a furniture entry as valid; absent, null and false mean no."""
    value = entry.get("valid")
    return value.strip().lower() in ("true", "1") if isinstance(value, str) else bool(value)


def key_of(uid: Any) -> str:
    """Normalise a `uid` or `ref`, usually a string, sometimes a number; "" for anything else."""
    return str(uid) if isinstance(uid, str | int) and uid != "" else ""


def _by_uid(entries: list[Any]) -> dict[str, dict[str, Any]]:
    """Index entries by uid; among entries with the same uid, a valid entry is preferred."""
    found: dict[str, dict[str, Any]] = {}
    for entry in entries:
        key = key_of(entry.get("uid")) if isinstance(entry, dict) else ""
        if key and (key not in found or (is_valid(entry) and not is_valid(found[key]))):
            found[key] = entry
    return found


@dataclass
class HouseRooms:
    """Rooms of one house file."""

    rooms: list[Room] = field(default_factory=list)
    left_out: list[Line] = field(default_factory=list)
    """Unusable rooms, and rooms left out by a rule."""


class _FilteredError(Exception):
    """A rule leaves the room out; the arguments are the rule's name and a sentence."""


def read_house(
    house: Path | House,
    models: ModelBank,
    recipe: Recipe,
    wanted: Callable[[str, str], bool] = lambda room_id, room_type: True,
    load_models: bool = True,
) -> HouseRooms:
    """Read the rooms of one house for which `wanted(room id, room type)` is true.

    The recipe maps categories to classes and limits the scales. `load_models=False` leaves every
    mesh empty (a survey).
    """
    if not isinstance(house, House):
        house = parse_house(house)
    reader = _RoomReader(house, models, recipe, load_models)
    result = HouseRooms()
    seen: set[str] = set()

    def leave_out(room_id: str, reason: str, status: str = "failed", rule: str = "") -> None:
        result.left_out.append(Line(room_id, house.name, status, rule, reason))

    for number, entry in enumerate(house.rooms):
        if not isinstance(entry, dict):
            leave_out(f"{house.name}_room{number}", "its entry is no JSON object")
            continue
        room_type = str(entry["type"]) if isinstance(entry.get("type"), str) else ""
        name = entry.get("instanceid") or room_type or f"room{number}"
        room_id = f"{house.name}_{name if is_name(name) else f'room{number}'}"
        if not wanted(room_id, room_type):
            continue
        if not is_name(name):
            leave_out(room_id, f"its instanceid, {shown(name)}, is not a valid name")
            continue
        if room_id in seen:
            leave_out(room_id, "another room of the house has the same instanceid")
            continue
        seen.add(room_id)
        try:
            result.rooms.append(reader.read(entry, room_id, room_type))
        except _FilteredError as rule:
            leave_out(room_id, rule.args[1], "filtered", rule.args[0])
        except InputError as error:
            leave_out(room_id, str(error))
        except (
            LookupError, TypeError, ValueError, AttributeError, ArithmeticError, OSError,
            RecursionError, shapely.GEOSException,
        ) as error:  # fmt: skip
            text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            leave_out(room_id, f"the room's entry cannot be read ({text})")
    return result


@dataclass(frozen=True)
class _RoomReader:
    """Reads the rooms of one house."""

    house: House
    models: ModelBank
    recipe: Recipe
    load_models: bool

    def read(self, room: dict[str, Any], room_id: str, room_type: str) -> Room:
        children = room.get("children") or []
        if not isinstance(children, list):
            raise InputError("its children are not a list")
        children = [child for child in children if isinstance(child, dict)]
        placed = [
            (child, entry)
            for child in children
            # This skips surfaces, dangling references, and furniture that 3D-FRONT marks as
            # invalid.
            if (entry := self.house.furniture.get(key_of(child.get("ref")))) and is_valid(entry)
        ]
        if not placed:
            raise _FilteredError("no_furniture", "no furniture stands in it")
        meshes = [self.house.meshes.get(key_of(child.get("ref")), {}) for child in children]
        if not any(mesh.get("type") == "Floor" for mesh in meshes):
            # Common for OtherRoom, which collects the furniture that stands in no room.
            raise _FilteredError("no_floor", "no floor belongs to it")
        notes: list[str] = []
        surfaces = self._surfaces(children, notes)
        floor, floor_y = floor_of(surfaces.get("Floor", []))
        room_from_house = room_frame(floor, floor_y)
        shell: dict[str, list[np.ndarray]] = {}
        for kind, parts in surfaces.items():
            shell.setdefault(STUFF_OF_MESH[kind], []).extend(
                part @ room_from_house[:3, :3].T + room_from_house[:3, 3] for part in parts
            )
        return Room(
            room_id,
            room_type,
            in_frame(floor, room_from_house),
            height_of(surfaces, floor_y),
            tuple(self._furniture(placed, room_from_house, notes)),
            tuple(notes),
            shell={name: np.concatenate(parts) for name, parts in shell.items()},
            without_model=tuple(self._without_model([entry for _, entry in placed])),
        )

    def _surfaces(
        self, children: list[dict[str, Any]], notes: list[str]
    ) -> dict[str, list[np.ndarray]]:
        surfaces: dict[str, list[np.ndarray]] = {}
        for child in children:
            mesh = self.house.meshes.get(key_of(child.get("ref")))
            kind = mesh.get("type") if mesh else None
            if mesh is None or kind not in STUFF_OF_MESH:
                continue
            try:
                surface, unusable = surface_of(mesh, child)
            except InputError as error:
                notes.append(f"a {kind} mesh is left out: {error}")
                continue
            if unusable:
                notes.append(f"a {kind} mesh has {unusable} triangles without valid corners")
            surfaces.setdefault(kind, []).append(surface)
        return surfaces

    def _furniture(
        self,
        placed: list[tuple[dict[str, Any], dict[str, Any]]],
        room_from_house: np.ndarray,
        notes: list[str],
    ) -> list[Furniture]:
        pieces: list[Furniture] = []
        seen: set[bytes] = set()
        for child, entry in placed:
            model_id = str(entry.get("jid") or "")
            try:
                matrix, scale = placement_of(child, required=("pos", "rot"))
                self._check_scale(model_id, scale)
                key = model_id.encode(errors="replace") + np.round(matrix, 4).tobytes()
                if key in seen:
                    notes.append(f"{shown(model_id)} stands twice at the same place; one is kept")
                    continue
                seen.add(key)
                if not self.models.has(model_id):
                    raise InputError(f"the models folder has no {MODEL_FILE} for it")
                model = self.models.load(model_id) if self.load_models else _NO_MESH
            except InputError as error:
                notes.append(f"{shown(model_id)} is left out: {error}")
                continue
            category = self.models.category(model_id)
            unit = np.diag([*[unit_of(model, entry)] * 3, 1.0])
            label, model_to_room = self.recipe.class_of(category), room_from_house @ matrix @ unit
            pieces.append(Furniture(label, category, model_id, model, model_to_room))
        return pieces

    def _check_scale(self, model_id: str, scale: np.ndarray) -> None:
        """Apply the recipe's two rules on scales; a piece scaled to zero is always left out."""
        limits, text = self.recipe.scale_range, ", ".join(f"{value:g}" for value in scale)
        name = shown(model_id)
        if limits and not all(limits[0] <= abs(value) <= limits[1] for value in scale):
            raise _FilteredError("scale_range", f"{name} is scaled by {text}, beyond scale_range")
        if not self.recipe.allow_mirrored and (scale < 0).any():
            raise _FilteredError("allow_mirrored", f"{name} is mirrored, scaled by {text}")
        if (np.abs(scale) < _FLAT).any():
            raise InputError(f"it is scaled by {text}, to nothing")

    def _without_model(self, entries: list[dict[str, Any]]) -> Iterator[tuple[str, str]]:
        """Model id and category of pieces without a model: from the release's list, else from the
        house."""
        for entry in entries:
            model_id, said = str(entry.get("jid") or ""), entry.get("category")
            if self.models.has(model_id):
                continue
            if not self.models.lists(model_id) and isinstance(said, str) and said.strip():
                yield model_id, tidy_category(said)
            else:
                yield model_id, self.models.category(model_id)

"""3D-FRONT house JSON + 3D-FUTURE models in, rooms out, whatever the quirks of the files."""

import functools
import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import shapely.affinity

from data_prep.rooms import Furniture, Room
from sceneprior.errors import InputError
from sceneprior.scene import Mesh

MODEL_FILE = "raw_model.obj"
_CENTIMETRES_FROM_M = 10.0
"""No piece of furniture is 10 m long; the release's oversized models (100x) all are."""
_FAR_M = 1e5
"""No house is this large; such numbers are damage."""
_DEFAULT_HEIGHT_M = 2.8
"""Ceiling height of the few rooms with neither inner walls nor a ceiling."""


class ModelBank:
    """3D-FUTURE: categories of all models, meshes on demand (the last few hundred are kept).

    Raises:
        InputError: the folder is missing, or is not 3D-FUTURE's.
    """

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise InputError(
                f"No folder at {folder}; --future names the folder of 3D-FUTURE models."
            )
        self._categories = _read_model_info(self.folder)
        self.load = functools.lru_cache(maxsize=512)(self._load)

    def category(self, model_id: str) -> str:
        """Lower case, "a / b" as "a/b"; "others" where the release says nothing."""
        return self._categories.get(model_id, "others")

    def has(self, model_id: str) -> bool:
        """Whether the release holds a mesh for this model."""
        return bool(model_id) and (self.folder / model_id / MODEL_FILE).is_file()

    def _load(self, model_id: str) -> Mesh:
        mesh = read_obj(self.folder / model_id / MODEL_FILE)
        longest = float(np.ptp(mesh.vertices_m, axis=0).max())
        if longest > _CENTIMETRES_FROM_M:
            return Mesh(mesh.vertices_m / np.float32(100), mesh.faces)
        return mesh


def _read_model_info(folder: Path) -> dict[str, str]:
    path = folder / "model_info.json"
    if not path.is_file():
        path = folder / "model_info_revised.json"
    if not path.is_file():
        raise InputError(
            f"{folder} has no model_info.json (nor model_info_revised.json), so it is not a folder "
            "of 3D-FUTURE models; --future usually ends in 3D-FUTURE-model."
        )
    data = _read_json(path)
    try:
        return {str(row["model_id"]): _category(row.get("category")) for row in data}
    except (TypeError, KeyError, AttributeError) as error:
        raise InputError(
            f"{path} is not 3D-FUTURE's list of models ({type(error).__name__}: {error})."
        ) from None


def _category(text: Any) -> str:
    return "others" if text is None else str(text).strip().lower().replace(" / ", "/")


def read_obj(path: Path) -> Mesh:
    """Vertices and triangles of a Wavefront OBJ, without materials, normals and unused vertices.

    Raises:
        InputError: the file cannot be read, or holds no triangle.
    """
    vertices: list[list[str]] = []
    polygons: list[list[str]] = []
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            for line in file:
                if line.startswith("v "):
                    vertices.append(line.split()[1:4])
                elif line.startswith("f "):
                    polygons.append([corner.split("/", 1)[0] for corner in line.split()[1:]])
        points = np.array(vertices, dtype=np.float32).reshape(-1, 3)
        corners = [
            (polygon[0], polygon[i - 1], polygon[i])
            for polygon in polygons
            for i in range(2, len(polygon))
        ]
        faces = np.array(corners, dtype=np.int64).reshape(-1, 3)
        # OBJ counts from 1, and from the end where negative (right for models of one group).
        faces = np.where(faces < 0, faces + len(points), faces - 1)
        used, faces = np.unique(faces, return_inverse=True)
        points = points[used]
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{path.parent.name}/{path.name} cannot be read ({error})") from None
    if not len(used) or used[0] < 0 or not np.isfinite(points).all():
        raise InputError(f"{path.parent.name}/{path.name} holds no usable triangles")
    return Mesh(points, faces.reshape(-1, 3).astype(np.int32))


def house_files(folder: Path) -> list[Path]:
    """The house files of a 3D-FRONT folder, sorted.

    Raises:
        InputError: the folder is missing or holds no JSON.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(
            f"No folder at {folder}; --front names the folder of 3D-FRONT's house JSONs."
        )
    if (folder / "model_info.json").exists():
        raise InputError(f"{folder} holds furniture models, not houses; give it as --future.")
    inside = folder / "3D-FRONT"
    files = [] if inside.is_dir() else sorted(folder.glob("*.json"))
    if not files:
        hint = f"; did you mean {inside}?" if inside.is_dir() else "."
        raise InputError(f"{folder} holds no house JSONs (<uid>.json){hint}")
    return files


@dataclass
class HouseRooms:
    """What one house file gave."""

    rooms: list[Room] = field(default_factory=list)
    failures: list[tuple[str, str]] = field(default_factory=list)
    """(room id, why it cannot be used)."""
    filtered: list[tuple[str, str]] = field(default_factory=list)
    """(room id, which rule leaves it out)."""


def read_house(
    path: Path,
    models: ModelBank,
    classes: dict[str, str],
    wanted: Callable[[str, str], bool] = lambda room_id, room_type: True,
    scale_range: tuple[float, float] | None = None,
    load_models: bool = True,
) -> HouseRooms:
    """Read the wanted rooms of one house.

    Args:
        path: `<house uid>.json`.
        models: Where furniture meshes come from.
        classes: Category -> class; a category that is not listed is `void`.
        wanted: Called with (room id, room type).
        scale_range: A room with a piece scaled beyond this is filtered.
        load_models: False leaves every mesh empty (a survey needs labels only).

    Raises:
        InputError: the file is not a house.
    """
    data = _read_json(path)
    try:
        rooms = [room for room in data["scene"]["room"] if isinstance(room, dict)]
        furniture = _by_uid(data["furniture"])
        meshes = _by_uid(data["mesh"])
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{path.name} is not a 3D-FRONT house ({type(error).__name__}: {error})."
        ) from None
    result = HouseRooms()
    seen: set[str] = set()
    for room in rooms:
        room_type = str(room.get("type") or "")
        room_id = f"{path.stem}_{room.get('instanceid') or room_type}"
        if not wanted(room_id, room_type):
            continue
        if room_id in seen:
            result.failures.append((room_id, "another room of the house has the same instanceid"))
            continue
        seen.add(room_id)
        try:
            result.rooms.append(
                _read_room(
                    room, room_id, room_type, furniture, meshes, models, classes, scale_range,
                    load_models,
                )
            )  # fmt: skip
        except _FilteredError as reason:
            result.filtered.append((room_id, str(reason)))
        except InputError as error:
            result.failures.append((room_id, str(error)))
        except (KeyError, TypeError, ValueError, AttributeError, shapely.GEOSException) as error:
            text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            result.failures.append((room_id, f"the room's entry cannot be read ({text})"))
    return result


class _FilteredError(Exception):
    """A rule leaves the room out."""


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path.name} is not JSON ({error}); it may be truncated.") from None


def _by_uid(entries: Any) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for entry in entries:
        if isinstance(entry, dict) and "uid" in entry:
            found.setdefault(str(entry["uid"]), entry)  # repeated uids carry the same model
    return found


def _read_room(
    room: dict[str, Any],
    room_id: str,
    room_type: str,
    furniture: dict[str, dict[str, Any]],
    meshes: dict[str, dict[str, Any]],
    models: ModelBank,
    classes: dict[str, str],
    scale_range: tuple[float, float] | None,
    load_models: bool,
) -> Room:
    children = [child for child in room.get("children") or [] if isinstance(child, dict)]
    surfaces: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for child in children:
        mesh = meshes.get(str(child.get("ref")))
        kind = str(mesh.get("type") or "") if mesh else ""
        if mesh and kind in ("Floor", "WallInner", "Ceiling"):
            surfaces.setdefault(kind, []).append(_surface(mesh, child))
    floor, floor_y = _floor(surfaces.get("Floor", []))
    room_from_world = _room_frame(floor, floor_y)
    xz = [0, 2]
    turned = shapely.affinity.affine_transform(
        floor, [*room_from_world[0, xz], *room_from_world[2, xz], *room_from_world[xz, 3]]
    )

    notes: list[str] = []
    pieces: list[Furniture] = []
    placed: set[bytes] = set()
    for child in children:
        entry = furniture.get(str(child.get("ref")))
        if entry is None or not _is_true(entry.get("valid")):
            continue  # a surface, a dangling reference, or furniture that 3D-FRONT itself rejects
        model_id = str(entry.get("jid") or "")
        try:
            placement, scale = _placement(child)
        except ValueError as error:
            notes.append(f"{model_id} is left out: {error}")
            continue
        if scale_range and not all(scale_range[0] <= abs(s) <= scale_range[1] for s in scale):
            raise _FilteredError(
                f"{model_id} is scaled by {', '.join(f'{s:g}' for s in scale)}, beyond scale_range"
            )
        key = model_id.encode() + np.round(placement, 4).tobytes()
        if key in placed:
            notes.append(f"{model_id} stands twice at the same place; one is kept")
            continue
        placed.add(key)
        if not models.has(model_id):
            notes.append(f"{model_id} is left out: the models folder has no {MODEL_FILE} for it")
            continue
        try:
            model = models.load(model_id) if load_models else _NO_MESH
        except InputError as error:
            notes.append(f"{model_id} is left out: {error}")
            continue
        category = models.category(model_id)
        pieces.append(
            Furniture(
                label=classes.get(category, "void"),
                category=category,
                model_id=model_id,
                model=model,
                model_to_room=room_from_world @ placement,
            )
        )
    return Room(room_id, room_type, turned, _height(surfaces, floor_y), tuple(pieces), tuple(notes))


_NO_MESH = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))


def _is_true(value: Any) -> bool:
    return value.strip().lower() in ("true", "1") if isinstance(value, str) else bool(value)


def _numbers(values: Any) -> np.ndarray:
    """Numbers, or strings of numbers, or one string with all of them."""
    if isinstance(values, str):
        values = values.replace(",", " ").strip("[]() ").split()
    return np.array([float(value) for value in values or []])


def _surface(mesh: dict[str, Any], child: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """A wall's or floor's triangles in the world: (V, 3) and (F, 3); no faces is no surface."""
    vertices = _numbers(mesh.get("xyz"))
    faces = _numbers(mesh.get("faces"))
    vertices = vertices[: len(vertices) // 3 * 3].reshape(-1, 3)
    faces = faces[: len(faces) // 3 * 3].reshape(-1, 3)
    faces = faces[((faces >= 0) & (faces < len(vertices))).all(axis=1)].astype(np.int64)
    usable = np.abs(vertices) < _FAR_M
    faces = faces[usable[faces].all(axis=(1, 2))]
    vertices = np.where(usable, vertices, 0.0)
    placement, _ = _placement(child)
    return vertices @ placement[:3, :3].T + placement[:3, 3], faces


def _placement(child: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """The child's 4 x 4 matrix, and its scale; quaternions are x, y, z, w."""
    place = _numbers(child.get("pos", (0, 0, 0)))
    x, y, z, w = quaternion = _numbers(child.get("rot", (0, 0, 0, 1)))
    scale = _numbers(child.get("scale", (1, 1, 1)))
    length = float(quaternion @ quaternion)
    if not (np.abs([*place, *scale, length]) < _FAR_M).all():  # NaN is not smaller, either
        raise ValueError("its placement holds numbers that are no places")
    if len(place) != 3 or len(scale) != 3 or length < 1e-12:
        raise ValueError("its placement is incomplete")
    s = 2 / length
    rotation = np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * scale
    matrix[:3, 3] = place
    return matrix, scale


def _floor(
    surfaces: Iterable[tuple[np.ndarray, np.ndarray]],
) -> tuple[shapely.Polygon | shapely.MultiPolygon, float]:
    """The union of all floor triangles in x and z, and the height of the largest floor mesh."""
    triangles = [vertices[faces] for vertices, faces in surfaces if len(faces)]
    polygons = [shapely.polygons(corners[:, :, [0, 2]]) for corners in triangles]
    areas = [float(shapely.area(group).sum()) for group in polygons]
    if not areas or max(areas) < 0.1:
        raise InputError("it has no floor")
    whole = shapely.union_all([polygon for group in polygons for polygon in group])
    if whole.geom_type != "Polygon" or whole.interiors:
        # Neighbouring floor meshes often leave a crack of rounding or of a door sill.
        whole = whole.buffer(0.05, join_style="mitre").buffer(-0.05, join_style="mitre")
    whole = whole.simplify(1e-4)
    largest = triangles[int(np.argmax(areas))]
    return whole, float(largest[:, :, 1].min())


def _room_frame(floor: shapely.Polygon | shapely.MultiPolygon, floor_y: float) -> np.ndarray:
    """The 4 x 4 matrix that lays walls along the axes and the floor's centre on the origin."""
    angle = _wall_angle(floor)
    cos, sin = (math.cos(angle), math.sin(angle)) if abs(angle) > 1e-4 else (1.0, 0.0)
    matrix = np.array([[cos, 0, sin, 0], [0, 1, 0, -floor_y], [-sin, 0, cos, 0], [0, 0, 0, 1.0]])
    x1, z1, x2, z2 = shapely.affinity.affine_transform(floor, [cos, sin, -sin, cos, 0, 0]).bounds
    matrix[[0, 2], 3] = -(x1 + x2) / 2, -(z1 + z2) / 2
    return matrix


def _wall_angle(floor: shapely.Polygon | shapely.MultiPolygon) -> float:
    """The turn, at most 45 degrees, after which most of the outline runs along x or z."""
    parts = getattr(floor, "geoms", [floor])
    edges = np.concatenate([np.diff(np.asarray(part.exterior.coords), axis=0) for part in parts])
    lengths = np.linalg.norm(edges, axis=1)
    # A turn by +a about y takes (x, z) = (cos t, sin t) to the angle t - a, so a = t.
    angles = np.arctan2(edges[:, 1], edges[:, 0])
    folded = (angles + math.pi / 4) % (math.pi / 2) - math.pi / 4
    # The direction that most length agrees with, then the mean of those that agree within 1 degree.
    close = np.abs((folded[:, None] - folded + math.pi / 4) % (math.pi / 2) - math.pi / 4) < 0.0175
    best = folded[int(np.argmax((close * lengths).sum(axis=1)))]
    offset = (folded - best + math.pi / 4) % (math.pi / 2) - math.pi / 4
    agreeing = np.abs(offset) < 0.0175
    return float(best + np.average(offset[agreeing], weights=lengths[agreeing]))


def _height(surfaces: dict[str, list[tuple[np.ndarray, np.ndarray]]], floor_y: float) -> float:
    for kind in ("WallInner", "Ceiling"):
        tops = [
            vertices[faces][..., 1].max()
            for vertices, faces in surfaces.get(kind, [])
            if len(faces)
        ]
        if tops and max(tops) - floor_y > 1.0:
            return float(max(tops)) - floor_y
    return _DEFAULT_HEIGHT_M

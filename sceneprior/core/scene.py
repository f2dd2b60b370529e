"""A room as 3D objects, and its JSON format, which generation writes and evaluation reads."""

import base64
import html
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import json_text, read_json
from sceneprior.core.instances.checked import checked

FORMAT = "sceneprior-scene"
VERSION = 1
LARGEST_M = 20.0
"""Maximum length of a piece of furniture; the longest wardrobes and shelves have half of it."""
FARTHEST_M = 100.0
"""Maximum absolute coordinate of a box centre or a corner of the floor."""
MOST_OBJECTS = 1000
"""Maximum number of objects in a room, because metrics compare all pairs."""
_DECIMALS = 5
_LEAST_M = 10.0**-_DECIMALS


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the room frame: vertices (V, 3) in metres, faces (F, 3) as indices.

    Other shapes, vertices that are not finite, and faces with an index out of range, at which the
    z-buffer would read beyond the array, raise an `InputError`.
    """

    vertices_m: np.ndarray
    faces: np.ndarray

    def __post_init__(self) -> None:
        vertices, faces = self.vertices_m, self.faces
        count = len(vertices)
        if vertices.shape != (count, 3) or faces.shape != (len(faces), 3):
            raise InputError(
                f"A mesh has vertices {vertices.shape} and faces {faces.shape}; expected "
                "(vertices, 3) and (faces, 3)."
            )
        if faces.dtype.kind not in "iu" or vertices.dtype.kind not in "iuf":
            raise InputError(
                f"A mesh has vertices of {vertices.dtype} and faces of {faces.dtype}; expected "
                "metres and whole numbers."
            )
        if not np.isfinite(vertices).all():
            raise InputError("A mesh has vertices that are not finite numbers.")
        if len(faces) and not (faces.min() >= 0 and faces.max() < count):
            wrong = faces.max() if faces.max() >= count else faces.min()
            raise InputError(
                f"A face of a mesh names vertex {wrong}, but its {count} vertices are 0 to "
                f"{count - 1}."
            )


def mesh_of_file(vertices_m: np.ndarray, faces: np.ndarray) -> Mesh:
    """Check a mesh read from a file: a valid `Mesh` with at least one triangle."""
    mesh = Mesh(np.asarray(vertices_m), np.asarray(faces))
    if not len(mesh.faces):
        raise InputError("A mesh has no triangle.")
    return mesh


class Turned(NamedTuple):
    """An oriented box: a rotation about +y (+z towards +x) and sizes."""

    yaw_rad: float
    size_m: tuple[float, float, float]
    """Full extents in the box's own frame."""


@dataclass(frozen=True)
class SceneObject:
    """A piece of furniture: class, axis-aligned box in the room frame, and optionally a mesh."""

    label: str
    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    mesh: Mesh | None = None
    turned: Turned | None = None
    """Oriented box whose axis-aligned bounding box has `size_m`, if known."""

    def __post_init__(self) -> None:
        # Convert to plain floats, because users print them.
        object.__setattr__(self, "center_m", _triple(self.center_m))
        object.__setattr__(self, "size_m", _triple(self.size_m))

    def in_box(self, center_m: Sequence[float], size_m: Sequence[float]) -> "SceneObject":
        """Copy of the object in another box; its mesh is moved and scaled accordingly."""
        center, size = _triple(center_m), _triple(size_m)
        mesh = self.mesh
        if mesh is not None:
            scale = np.asarray(size) / np.maximum(self.size_m, 1e-9)
            vertices_m = (mesh.vertices_m - np.asarray(self.center_m)) * scale + np.asarray(center)
            mesh = Mesh(vertices_m, mesh.faces)
        return SceneObject(self.label, center, size, mesh)


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)


@dataclass(frozen=True)
class Scene:
    """Objects of one room, in metres: y up, floor at y = 0, origin at the floor's centre."""

    name: str
    label_set: str
    objects: tuple[SceneObject, ...] = ()
    floor_m: np.ndarray | None = None
    """(P, 2) outline of the floor as x, z; None if unknown, as for generated rooms."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Origin of the scene (seed, run, room), written to the JSON and never interpreted."""
    latent: np.ndarray | None = field(default=None, compare=False, repr=False)
    """(D,) latent vector that the scene was decoded from, if any."""

    @property
    def class_indices(self) -> np.ndarray:
        """Indices of the objects' classes in the label set, (objects,) int64."""
        names = label_set(self.label_set)
        return np.array([names.index(item.label) for item in self.objects], dtype=np.int64)

    @property
    def centers_m(self) -> np.ndarray:
        """Box centres, (objects, 3) float64."""
        return np.array([item.center_m for item in self.objects], dtype=np.float64).reshape(-1, 3)

    @property
    def sizes_m(self) -> np.ndarray:
        """Full extents of the boxes along x, y, z, (objects, 3) float64."""
        return np.array([item.size_m for item in self.objects], dtype=np.float64).reshape(-1, 3)

    def without_meshes(self) -> "Scene":
        """Copy of the scene with boxes instead of meshes, for methods without meshes."""
        return replace(self, objects=tuple(replace(item, mesh=None) for item in self.objects))

    def save(self, path: Path | str) -> None:
        """Write the scene to a file: `.json`, `.glb`, `.obj`, `.usda` or `.png`; see `save_scene`.

        >>> from tempfile import TemporaryDirectory
        >>> bed = SceneObject("double_bed", (0.0, 0.3, 0.0), (1.8, 0.6, 2.0))
        >>> with TemporaryDirectory() as folder:
        ...     Scene("mine", "front3d_bedroom", (bed,)).save(f"{folder}/mine.glb")
        ...     Path(f"{folder}/mine.glb").read_bytes()[:4]
        b'glTF'
        """
        from sceneprior.render.scene_files import save_scene

        save_scene(self, Path(path))

    def picture(self) -> np.ndarray:
        """Render the room shaded, from above a corner, (360, 480, 3) uint8; not for evaluation.

        >>> Scene("empty", "front3d_bedroom").picture().shape
        (360, 480, 3)
        """
        from sceneprior.render.offscreen import open_renderer
        from sceneprior.render.topdown import perspective

        return perspective(self, open_renderer())

    def show(self) -> None:
        """Display the scene from any line of a notebook's cell; elsewhere an `InputError`."""
        notebook = sys.modules.get("IPython")
        if notebook is None or notebook.get_ipython() is None:
            raise InputError(
                "Scene.show() draws in a notebook, and this is none; scene.save('room.png') writes "
                "a picture, and 'room.glb' a model."
            )
        notebook.display.display(self)

    def _repr_html_(self) -> str:
        """HTML for notebooks: a picture of the scene and its number of objects per class.

        >>> "no objects" in Scene("empty", "front3d_bedroom")._repr_html_()
        True
        """
        from sceneprior.render.pictures import png_bytes

        counted = Counter(item.label for item in self.objects).most_common()
        told = ", ".join(f"{count} {label}" for label, count in counted) or "no objects"
        picture = base64.b64encode(png_bytes(self.picture())).decode()
        return (
            f'<figure><img src="data:image/png;base64,{picture}" alt="a room">'
            f"<figcaption>{html.escape(self.name)}: {told}</figcaption></figure>"
        )


def scene_to_json(scene: Scene) -> dict[str, Any]:
    """Convert a scene to its JSON format (docs/conventions.md): classes and boxes, no meshes."""
    objects = []
    for item in scene.objects:
        entry: dict[str, Any] = {"class": item.label}
        entry["center_m"] = [round(value, _DECIMALS) for value in item.center_m]
        entry["size_m"] = _rounded_size(item.size_m)
        if item.turned is not None:
            entry["yaw_rad"] = round(item.turned.yaw_rad, 7)
            entry["own_size_m"] = _rounded_size(item.turned.size_m)
        objects.append(entry)
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": scene.name,
        "label_set": scene.label_set,
        "units": "metres",
        "axes": "x right, y up, z towards the viewer; floor at y = 0, its centre at the origin",
        "objects": objects,
        **({} if scene.floor_m is None else {"floor_m": scene.floor_m.tolist()}),
        **({"extra": scene.extra} if scene.extra else {}),
    }


def _rounded_size(size_m: Sequence[float]) -> list[float]:
    # A flat side stays above 0, because `read_scene` rejects sizes of 0.
    return [max(round(value, _DECIMALS), _LEAST_M) for value in size_m]


# Strict, because "1.8" and true are not valid lengths; JSON has lists for our tuples.
_STRICT = ConfigDict(strict=True)
_Triple = Annotated[tuple[float, float, float], Field(strict=False)]
_Pair = Annotated[tuple[float, float], Field(strict=False)]


class _ObjectEntry(BaseModel):
    model_config = _STRICT

    label: str = Field(alias="class")
    center_m: _Triple
    size_m: _Triple
    yaw_rad: float | None = None
    own_size_m: _Triple | None = None


class _SceneEntry(BaseModel):
    model_config = _STRICT

    name: str | None = None
    label_set: str
    objects: Annotated[list[_ObjectEntry], Field(max_length=MOST_OBJECTS)]
    floor_m: Annotated[list[_Pair], Field(min_length=3)] | None = None
    extra: dict[str, Any] = {}


def read_scene(path: Path) -> Scene:
    """Read a scene's JSON."""
    path = Path(path)
    data = read_json(path)
    where = f"{path} is not a scene JSON, which docs/conventions.md describes"
    if not isinstance(data, dict) or not {"format", "version"} <= data.keys():
        raise InputError(f"{where}: expected an object with 'format', 'version' and 'objects'.")
    if (data["format"], data["version"]) != (FORMAT, VERSION):
        raise InputError(
            f"{path} says format '{_short(data['format'])}' version {_short(data['version'])}; "
            f"expected '{FORMAT}' version {VERSION}. Write it again with `sceneprior synthesize`."
        )
    entry = checked(_SceneEntry, data, where)
    try:
        json_text(entry.extra)  # it is written again with the scene
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: extra cannot be written as JSON ({error}).") from None
    names = label_set(entry.label_set)
    objects = []
    for item in entry.objects:
        if item.label not in names:
            raise InputError(
                f"{path}: class '{_short(item.label)}' is not in label set "
                f"'{_short(entry.label_set)}'; use one of {', '.join(names)}."
            )
        check_box(path, item.label, item.center_m, item.size_m)
        turned = _turned_of(path, item)
        objects.append(SceneObject(item.label, item.center_m, item.size_m, turned=turned))
    floor = None if entry.floor_m is None else np.array(entry.floor_m, dtype=np.float64)
    if floor is not None:
        check_floor(path, floor)
    name = path.stem if entry.name is None else entry.name
    return Scene(name, entry.label_set, tuple(objects), floor, entry.extra)


def check_box(path: Path, label: str, center_m: Sequence[float], size_m: Sequence[float]) -> None:
    """Reject an implausible box; all readers of boxes use this check."""
    said = f"{path}: a {label} has centre {[*center_m]} and size {[*size_m]}"
    if not np.isfinite([*center_m, *size_m]).all() or min(size_m) <= 0:
        raise InputError(f"{said}; expected finite metres, and sizes above 0.")
    if max(size_m) > LARGEST_M or np.abs(center_m).max() > FARTHEST_M:
        raise InputError(
            f"{said}; no furniture is above {LARGEST_M:g} m long, or further than "
            f"{FARTHEST_M:g} m from the floor's centre. {_unit_guess([*center_m, *size_m])}"
        )


def check_floor(path: Path, outline_m: np.ndarray) -> None:
    """Reject a floor outline that is implausibly large, or has no area."""
    far = np.abs(outline_m).max(initial=0)
    if not far <= FARTHEST_M:
        raise InputError(
            f"{path}: the floor reaches {far:g} m from its centre; expected finite metres, at most "
            f"{FARTHEST_M:g}. {_unit_guess(far)}"
        )
    if np.linalg.matrix_rank(outline_m - outline_m[0]) < 2:
        raise InputError(f"{path}: all corners of the floor lie on one line, so it has no area.")


def _unit_guess(numbers: Any) -> str:
    unit = "millimetres" if np.abs(numbers).max() > 1000 else "centimetres"
    return f"Are these {unit}? Give metres."


def _turned_of(path: Path, item: _ObjectEntry) -> Turned | None:
    """Oriented box of an entry, if it has one; it must fill the axis-aligned box."""
    if item.yaw_rad is None and item.own_size_m is None:
        return None
    if item.yaw_rad is not None and item.own_size_m is not None:
        check_box(path, item.label, item.center_m, item.own_size_m)
        turned = Turned(item.yaw_rad, item.own_size_m)
        if np.allclose(bound_m(turned), item.size_m, rtol=0, atol=1e-3):
            return turned
    raise InputError(
        f"{path}: a {item.label} of size_m {item.size_m} has yaw_rad {item.yaw_rad} and "
        f"own_size_m {item.own_size_m}; expected both, such that the box turned by yaw_rad fills "
        "size_m, or neither."
    )


def bound_m(turned: Turned) -> tuple[float, float, float]:
    """Extents of the axis-aligned bounding box of an oriented box.

    >>> [round(side, 3) for side in bound_m(Turned(np.pi / 4, (1.0, 0.7, 1.0)))]
    [1.414, 0.7, 1.414]
    """
    width, height, depth = turned.size_m
    cosine, sine = abs(np.cos(turned.yaw_rad)), abs(np.sin(turned.yaw_rad))
    return _triple((cosine * width + sine * depth, height, sine * width + cosine * depth))


def _short(text: object) -> str:
    """Shorten a value from a file for a message."""
    return str(text)[:60]

"""The objects of one room in 3D and their JSON, which generation writes and evaluation reads."""

import base64
import html
import json
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from sceneprior.classes import label_set
from sceneprior.errors import InputError

FORMAT = "sceneprior-scene"
VERSION = 1


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the room frame: vertices (V, 3) in metres, faces (F, 3) as indices."""

    vertices_m: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True)
class SceneObject:
    """A piece of furniture: its class, its axis-aligned box in the room frame, perhaps its mesh."""

    label: str
    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    mesh: Mesh | None = None

    def __post_init__(self) -> None:
        # Plain floats, wherever the box comes from: users print them.
        object.__setattr__(self, "center_m", _triple(self.center_m))
        object.__setattr__(self, "size_m", _triple(self.size_m))

    def in_box(self, center_m: Sequence[float], size_m: Sequence[float]) -> "SceneObject":
        """The same object in another box: its mesh moves and is scaled with its own."""
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
    """The objects of one room; y is up, the floor is y = 0, its centre the origin (metres)."""

    name: str
    label_set: str
    objects: tuple[SceneObject, ...] = ()
    floor_m: np.ndarray | None = None
    """(P, 2) outline of the floor as x, z; None where it is unknown (a generated room)."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Where the scene comes from: seed, run, room. Written to the JSON, never interpreted."""
    latent: np.ndarray | None = field(default=None, compare=False, repr=False)
    """(D,) the point of a prior's latent space that this is decoded from, where one is."""

    @property
    def class_indices(self) -> np.ndarray:
        """(objects,) int64 index of each object's class in the label set."""
        names = label_set(self.label_set)
        return np.array([names.index(item.label) for item in self.objects], dtype=np.int64)

    @property
    def centers_m(self) -> np.ndarray:
        """(objects, 3) float64 box centres."""
        return np.array([item.center_m for item in self.objects], dtype=np.float64).reshape(-1, 3)

    @property
    def sizes_m(self) -> np.ndarray:
        """(objects, 3) float64 full extents of the boxes along x, y, z."""
        return np.array([item.size_m for item in self.objects], dtype=np.float64).reshape(-1, 3)

    def without_meshes(self) -> "Scene":
        """The same boxes, drawn as boxes: for methods that have no meshes."""
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
        from sceneprior.scene_files import save_scene

        save_scene(self, Path(path))

    def picture(self) -> np.ndarray:
        """(360, 480, 3) uint8, shaded, from above a corner: for people, not for scores.

        >>> Scene("empty", "front3d_bedroom").picture().shape
        (360, 480, 3)
        """
        from sceneprior.offscreen import open_renderer
        from sceneprior.topdown import perspective

        return perspective(self, open_renderer())

    def show(self) -> None:
        """Show the picture in a notebook, wherever in a cell.

        Raises:
            InputError: this is no notebook.
        """
        notebook = sys.modules.get("IPython")
        if notebook is None or notebook.get_ipython() is None:
            raise InputError(
                "Scene.show() draws in a notebook, and this is none; scene.save('room.png') writes "
                "a picture, and 'room.glb' a model."
            )
        notebook.display.display(self)

    def _repr_html_(self) -> str:
        """What a notebook shows of a scene: its picture, and how many objects of which class.

        >>> "no objects" in Scene("empty", "front3d_bedroom")._repr_html_()
        True
        """
        from sceneprior.pictures import png_bytes

        counted = Counter(item.label for item in self.objects).most_common()
        told = ", ".join(f"{count} {label}" for label, count in counted) or "no objects"
        picture = base64.b64encode(png_bytes(self.picture())).decode()
        return (
            f'<figure><img src="data:image/png;base64,{picture}" alt="a room">'
            f"<figcaption>{html.escape(self.name)}: {told}</figcaption></figure>"
        )


def scene_to_json(scene: Scene) -> dict[str, Any]:
    """The documented JSON of a scene (docs/conventions.md): classes and boxes, no meshes."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": scene.name,
        "label_set": scene.label_set,
        "units": "metres",
        "axes": "x right, y up, z towards the viewer; floor at y = 0, its centre at the origin",
        "objects": [
            {
                "class": item.label,
                "center_m": [round(value, 5) for value in item.center_m],
                "size_m": [round(value, 5) for value in item.size_m],
            }
            for item in scene.objects
        ],
        **({} if scene.floor_m is None else {"floor_m": scene.floor_m.tolist()}),
        **({"extra": scene.extra} if scene.extra else {}),
    }


class _ObjectEntry(BaseModel):
    label: str = Field(alias="class")
    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]


class _SceneEntry(BaseModel):
    name: str | None = None
    label_set: str
    objects: list[_ObjectEntry]
    floor_m: Any = None
    extra: dict[str, Any] = {}


def read_scene(path: Path) -> Scene:
    """Read a scene's JSON.

    Raises:
        InputError: the file is missing, not JSON, not this format, names unknown classes, or
            holds numbers that no room has.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text())
        if isinstance(data, dict) and (data["format"], data["version"]) != (FORMAT, VERSION):
            raise InputError(
                f"{path} says format '{data['format']}' version {data['version']}; "
                f"expected '{FORMAT}' version {VERSION}. Write it again with "
                "`sceneprior synthesize`."
            )
        entry = _SceneEntry.model_validate(data)
        floor = None if entry.floor_m is None else np.asarray(entry.floor_m, dtype=np.float64)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from None
    except (ValueError, KeyError, TypeError) as error:
        reason = f"{type(error).__name__}: {error}"
        if isinstance(error, ValidationError):
            first = error.errors(include_url=False)[0]
            reason = ": ".join([".".join(map(str, first["loc"])), first["msg"]]).lstrip(": ")
        raise InputError(
            f"{path} is not a scene JSON: expected an object with 'format' and 'objects' "
            f"({reason}); docs/conventions.md describes the format."
        ) from None
    names = label_set(entry.label_set)
    for item in entry.objects:
        if item.label not in names:
            raise InputError(
                f"{path}: class '{item.label}' is not in label set '{entry.label_set}'; "
                f"use one of {', '.join(names)}."
            )
        if not np.isfinite([*item.center_m, *item.size_m]).all() or min(item.size_m) < 0:
            raise InputError(
                f"{path}: a {item.label} has centre {list(item.center_m)} and size "
                f"{list(item.size_m)}; expected finite metres, and sizes not below 0."
            )
    if floor is not None and (
        floor.ndim != 2 or floor.shape[1] != 2 or len(floor) < 3 or not np.isfinite(floor).all()
    ):
        raise InputError(
            f"{path}: floor_m has shape {floor.shape}; expected at least 3 corners [x, z] in "
            "finite metres, or no floor_m."
        )
    return Scene(
        name=path.stem if entry.name is None else entry.name,
        label_set=entry.label_set,
        objects=tuple(SceneObject(o.label, o.center_m, o.size_m) for o in entry.objects),
        floor_m=floor,
        extra=entry.extra,
    )

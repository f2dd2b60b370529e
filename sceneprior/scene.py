"""One room of objects in 3D, as numbers: what synthesis writes and evaluation reads."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

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


@dataclass(frozen=True)
class Scene:
    """The objects of one room; y is up, the floor is y = 0, its centre the origin (metres)."""

    name: str
    label_set: str
    objects: tuple[SceneObject, ...] = ()
    floor_m: np.ndarray | None = None
    """(P, 2) outline of the floor as x, z; None where nobody knows it (a generated room)."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Where the scene comes from: seed, run, room. Written to the JSON, never interpreted."""

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
                "center_m": [round(float(value), 5) for value in item.center_m],
                "size_m": [round(float(value), 5) for value in item.size_m],
            }
            for item in scene.objects
        ],
        **({} if scene.floor_m is None else {"floor_m": scene.floor_m.tolist()}),
        **({"extra": scene.extra} if scene.extra else {}),
    }


def read_scene(path: Path) -> Scene:
    """Read a scene's JSON.

    Raises:
        InputError: the file is missing, not JSON, not this format, names unknown classes, or
            holds numbers that no room has.
    """
    try:
        data = json.loads(Path(path).read_text())
        if not isinstance(data, dict):
            raise InputError(
                f"{path} is not a scene JSON: expected an object with 'format' and 'objects', got "
                f"a {type(data).__name__}; docs/conventions.md describes the format."
            )
        if data["format"] != FORMAT or data["version"] != VERSION:
            raise InputError(
                f"{path} says format '{data['format']}' version {data['version']}; "
                f"expected '{FORMAT}' version {VERSION}. Write it again with "
                "`sceneprior synthesize`."
            )
        names = label_set(data["label_set"])
        for item in data["objects"]:
            if item["class"] not in names:
                raise InputError(
                    f"{path}: class '{item['class']}' is not in label set '{data['label_set']}'; "
                    f"use one of {', '.join(names)}."
                )
        objects = tuple(
            SceneObject(item["class"], _triple(item["center_m"]), _triple(item["size_m"]))
            for item in data["objects"]
        )
        floor = data.get("floor_m")
        floor_m = None if floor is None else np.asarray(floor, dtype=np.float64)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} is not a scene JSON ({type(error).__name__}: {error}); "
            "docs/conventions.md describes the format."
        ) from None
    scene = Scene(
        name=str(data.get("name", Path(path).stem)),
        label_set=data["label_set"],
        objects=objects,
        floor_m=floor_m,
        extra=data.get("extra", {}),
    )
    _check_numbers(path, scene)
    return scene


def _check_numbers(path: Path, scene: Scene) -> None:
    for item in scene.objects:
        if not np.isfinite([*item.center_m, *item.size_m]).all() or min(item.size_m) < 0:
            raise InputError(
                f"{path}: a {item.label} has centre {list(item.center_m)} and size "
                f"{list(item.size_m)}; expected finite metres, and sizes not below 0."
            )
    floor = scene.floor_m
    if floor is not None and (
        floor.ndim != 2 or floor.shape[1] != 2 or len(floor) < 3 or not np.isfinite(floor).all()
    ):
        raise InputError(
            f"{path}: floor_m has shape {floor.shape}; expected at least 3 corners [x, z] in "
            "finite metres, or no floor_m."
        )


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)

"""CAD models by class, with points on their surfaces: of a folder's files, or the package's own.

Points of files are sampled once per model and cached in one file; they are sampled again when the
model's file changes. The package's own furniture (`sceneprior/furniture`) is built when an object
first needs its class, in 10 to 100 ms.
"""

import hashlib
import io
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sceneprior.apps.retrieval.model_folders import ModelFiles, find_models
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import file_stamp, write_whole
from sceneprior.core.scene import Mesh, Textured
from sceneprior.core.surfaces import surface_points
from sceneprior.furniture.catalog import Model, furniture_classes, make_variants

POINTS = 1024
"""Points per surface; on a surface of 2 m2, one every 4 to 5 cm."""
SEED = 0
FORMAT = 2
"""Version of the cache file; increase it when the sampling of points changes."""
_FLAT = 1e-9
"""Ratio to the longest side up to which a side counts as flat; flat sides are not scaled."""
_MESHES_KEPT = 256
_TEXTURED_KEPT = 32

Track = Callable[[list[str]], Iterable[str]]
"""Wraps an iterable of model ids, for a progress bar."""


@dataclass(frozen=True)
class ClassModels:
    """The models of one class."""

    model_ids: tuple[str, ...]
    points: Float[np.ndarray, "models points 3"]
    """Points on the surface of each model, which is scaled to fill [-0.5, 0.5]^3."""


@dataclass(frozen=True)
class CadModels:
    """Models by class, and a function that loads their meshes."""

    by_class: Mapping[str, ClassModels]
    load: Callable[[str], Mesh]
    """Loads the mesh of a model id, scaled to fill [-0.5, 0.5]^3."""
    textured: Callable[[str], tuple[Textured, ...]] = lambda model_id: ()
    """Loads the parts of this mesh with their materials; none for a model without materials."""
    broken: Mapping[str, str] = field(default_factory=dict)
    """Ids of unusable models, each with the reason."""


def default_cache() -> Path:
    """The default cache folder: $XDG_CACHE_HOME/sceneprior, or ~/.cache/sceneprior."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sceneprior"


def open_models(
    folder: Path,
    label_set_name: str,
    cache: Path | None = None,
    points: int = POINTS,
    track: Track = iter,
) -> CadModels:
    """Open the models of a label set's classes, with points on their surfaces.

    Args:
        folder: The models of 3D-FUTURE, shards of `prep-front` with this label set, or GLBs and
            OBJs in sub-folders by class; see `model_folders.py`.
        cache: Folder for the cache file of points, by default `default_cache()`.
    """
    folder = Path(folder)
    found = find_models(folder, label_set_name)
    files, labels = found.paths, found.labels
    drawn, unread = _points_of_models(folder, found, cache or default_cache(), points, track)
    broken = {**found.broken, **unread}
    by_class = {}
    for label in label_set(label_set_name):
        if of_class := [m for m in files if labels[m] == label and m not in broken]:
            stack = np.stack([drawn[m] for m in of_class])
            by_class[label] = ClassModels(tuple(of_class), stack)
    if not by_class:
        raise InputError(
            f"{folder} holds no usable model of a class of {label_set_name} ({len(labels)} models "
            f"listed, {len(broken)} of them broken); give --models a folder with model files."
        )

    def load(model_id: str) -> Mesh:
        return unit_mesh(found.read(files[model_id]))

    def textured(model_id: str) -> tuple[Textured, ...]:
        whole = np.asarray(found.read(files[model_id]).vertices_m, dtype=np.float64)
        return tuple(
            part._replace(mesh=Mesh(unit_points(part.mesh.vertices_m, whole), part.mesh.faces))
            for part in found.textured(files[model_id])
        )

    return CadModels(
        by_class, lru_cache(_MESHES_KEPT)(load), lru_cache(_TEXTURED_KEPT)(textured), broken
    )


def unit_mesh(mesh: Mesh) -> Mesh:
    """Move and scale a mesh to fill [-0.5, 0.5]^3; a flat side becomes 0."""
    vertices = np.asarray(mesh.vertices_m, dtype=np.float64)
    return Mesh(unit_points(vertices, vertices), mesh.faces)


def unit_points(points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Points of a mesh, moved and scaled with it; see `unit_mesh`."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    sides = high - low
    scale = np.where(sides > _FLAT * sides.max(), 1 / np.maximum(sides, 1e-300), 0.0)
    return (points - (low + high) / 2) * scale


def _points_of_models(
    folder: Path, found: ModelFiles, cached: Path, count: int, track: Track
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Sample `count` points of each model; returns them, and the reasons for broken models.

    The points are cached in an npz in the folder `cached`, even if sampling is interrupted.
    """
    settings = f"{folder.resolve()}|{count}|{SEED}|{FORMAT}"
    kept = cached / f"points-{hashlib.sha256(settings.encode()).hexdigest()[:16]}.npz"
    before = _read_points(kept)
    keys, broken = dict[str, str](), dict[str, str]()
    for model_id, path in found.paths.items():
        try:
            keys[model_id] = f"{model_id} {file_stamp(path)}"
        except InputError as error:
            broken[model_id] = str(error)
    points = {key: before[key] for key in keys.values() if key in before}
    try:
        for model_id in track([m for m, key in keys.items() if key not in points]):
            try:
                mesh = found.read(found.paths[model_id])
                points[keys[model_id]] = _unit_samples(mesh.vertices_m, mesh.faces, count)
            except (InputError, ValueError) as error:
                broken[model_id] = str(error)
    finally:
        if points.keys() - before.keys():
            buffer = io.BytesIO()
            np.savez(buffer, keys=np.array(list(points)), points=np.stack(list(points.values())))
            write_whole(kept, buffer.getvalue())
    return {m: points[key] for m, key in keys.items() if key in points}, broken


def _read_points(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return dict(zip(file["keys"].tolist(), file["points"], strict=True))
    except Exception:  # absent or damaged: points are sampled again
        return {}


def _unit_samples(
    vertices: np.ndarray, faces: np.ndarray, count: int
) -> Float[np.ndarray, "{count} 3"]:
    """Points on a surface, moved and scaled with it to the unit box.

    They are sampled before scaling, which would enlarge thin sides.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    points = surface_points(vertices, faces, count, SEED)
    return unit_points(points, vertices).astype(np.float32)


# -- The package's own models ----------------------------------------------------------------------


@cache
def made_models() -> CadModels:
    """The package's own models of all classes that have tables of parts.

    A class has the models of `make_variants`, in its styles and in sizes of real furniture. Their
    meshes are unions of closed solids.
    """
    return CadModels(_Made(), _load)


class _Made(Mapping[str, ClassModels]):
    """Models by class, each class built when it is first read."""

    def __getitem__(self, label: str) -> ClassModels:
        if label not in furniture_classes():
            raise KeyError(label)
        return _made_of(label)

    def __iter__(self) -> Iterator[str]:
        return iter(furniture_classes())

    def __len__(self) -> int:
        return len(furniture_classes())


@cache
def _made_of(label: str) -> ClassModels:
    points = [_unit_samples(*_arrays(model), POINTS) for model in _variants(label)]
    ids = tuple(f"{label}_{row:02d}" for row in range(len(points)))
    return ClassModels(ids, np.stack(points))


@cache
def _load(model_id: str) -> Mesh:
    label, _, row = model_id.rpartition("_")
    return unit_mesh(Mesh(*_arrays(_variants(label)[int(row)])))


@cache
def _variants(label: str) -> list[Model]:
    return make_variants(SEED, label)


def _arrays(model: Model) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(model.mesh.vertices), np.asarray(model.mesh.faces)

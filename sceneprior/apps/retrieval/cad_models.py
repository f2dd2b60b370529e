"""CAD models by class, with points on their surfaces: of a folder, or the package's own furniture.

A folder has one of three layouts:

<folder>/model_info.json, <model id>/raw_model.obj      3D-FUTURE
<folder>/index.json, models/<model id>.ply              shards of `prep-front`
<folder>/<class>/<any name>.glb or .obj                 the user's own models

Points of files are sampled once per model and cached in one file; they are sampled again when the
model's file changes. The package's own furniture (`sceneprior/furniture`) is built when an object
first needs its class, in 10 to 100 ms.
"""

import contextlib
import hashlib
import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.progress import track

from sceneprior.core.checked import keep_arrays, kept_arrays
from sceneprior.core.classes import LABEL_SETS, label_set
from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.files import (
    file_stamp,
    is_name,
    list_files,
    list_folders,
)
from sceneprior.core.furniture import (
    INFO_FILES,
    MODEL_FILE,
    category_table,
    class_of_category,
    model_categories,
    read_obj,
    tidy_category,
)
from sceneprior.core.ground_truth import model_path, read_model
from sceneprior.core.parallel import once
from sceneprior.core.scene import Mesh, Textured
from sceneprior.core.shards import INDEX_NAME, iterate_rooms
from sceneprior.core.surfaces import surface_points
from sceneprior.furniture.catalog import furniture_classes, make_variants
from sceneprior.render.model_files import joined, load_parts

POINTS = 1024
"""Points per surface; on a surface of 2 m2, one every 4 to 5 cm."""
SEED = 0
FORMAT = 3
"""Version of the cache file; increase it when models are read or sampled otherwise."""
_FLAT = 1e-9
"""Ratio to the longest side up to which a side counts as flat; flat sides are not scaled."""
_MESHES_KEPT = 256
_TEXTURED_KEPT = 32


@dataclass(frozen=True)
class ClassModels:
    """The models of one class."""

    model_ids: tuple[str, ...]
    points: Float[np.ndarray, "models points 3"]
    """Points on the surface of each model, which is scaled to fill [-0.5, 0.5]^3."""

    def only(self, model_id: str) -> "ClassModels":
        """One of the models."""
        row = self.model_ids.index(model_id)
        return ClassModels((model_id,), self.points[row : row + 1])


@dataclass(frozen=True)
class CadModels:
    """Functions that give the models of a class, and load a model by its id."""

    of_class: Callable[[str], ClassModels | None]
    load: Callable[[str], Mesh]
    """Loads the mesh of a model id, scaled to fill [-0.5, 0.5]^3."""
    textured: Callable[[str], tuple[Textured, ...]] = lambda model_id: ()
    """Loads the parts of this mesh with their materials; none for a model without materials."""
    broken: Mapping[str, str] = field(default_factory=dict)
    """Ids of unusable models, each with the reason."""
    opened_by: tuple[Any, ...] = ()
    """The function that opens the same models in a worker, and its arguments."""

    def __reduce__(self) -> tuple[Any, ...]:
        return once, self.opened_by


@cache
def _made_of(label: str) -> tuple[ClassModels, dict[str, Mesh]]:
    """The package's own models of a class, and their meshes, which are unions of closed solids."""
    points, meshes = [], {}
    for row, model in enumerate(make_variants(SEED, label)):
        mesh = Mesh(np.asarray(model.mesh.vertices), np.asarray(model.mesh.faces))
        points.append(_unit_samples(mesh))
        meshes[f"{label}_{row:02d}"] = unit_mesh(mesh)
    return ClassModels(tuple(meshes), np.stack(points)), meshes


def made_models() -> CadModels:
    """The package's own models of all classes that have tables of parts.

    A class has the models of `make_variants`, in its styles and in sizes of real furniture.
    """
    return CadModels(
        lambda label: _made_of(label)[0] if label in furniture_classes() else None,
        lambda model_id: _made_of(model_id.rpartition("_")[0])[1][model_id],
        opened_by=(made_models,),
    )


# -- The models of a folder ------------------------------------------------------------------------


class _ModelFiles(NamedTuple):
    """Files of the models of a label set's classes."""

    labels: Mapping[str, str]
    """Class of every model by its id; `void` if the label set has no class for it."""
    path_of: Callable[[str], Path]
    read: Callable[[Path], Mesh]
    textured: Callable[[Path], tuple[Textured, ...]] = lambda path: ()
    """Reads the parts of a model with their materials; none for models in class colours."""


def open_models(folder: Path, label_set_name: str, cache: Path | None = None) -> CadModels:
    """Open the models of a label set's classes, with points on their surfaces.

    Args:
        folder: The models of 3D-FUTURE, shards of `prep-front` with this label set, or GLBs and
            OBJs in sub-folders by class.
        cache: Folder for the cache file of points, by default $XDG_CACHE_HOME/sceneprior or
            ~/.cache/sceneprior.

    Raises:
        InputError: the folder is missing, has none of the layouts, or no usable model.
    """
    folder = Path(folder)
    files = _find_models(folder, label_set_name)
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    points, broken = _points_of_models(folder, files, cache or home / "sceneprior")
    by_class = {}
    for label in label_set(label_set_name):
        if ids := tuple(m for m in points if files.labels[m] == label):
            by_class[label] = ClassModels(ids, np.stack([points[m] for m in ids]))
    if not by_class:
        raise InputError(
            f"{folder} holds no usable model of a class of {label_set_name} ({len(files.labels)} "
            f"models listed, {len(broken)} of them broken); give --models a folder with model "
            "files."
        )

    def load(model_id: str) -> Mesh:
        return unit_mesh(files.read(files.path_of(model_id)))

    def textured(model_id: str) -> tuple[Textured, ...]:
        path = files.path_of(model_id)
        whole = np.asarray(files.read(path).vertices_m, dtype=np.float64)
        return tuple(
            part._replace(mesh=Mesh(_unit_points(part.mesh.vertices_m, whole), part.mesh.faces))
            for part in files.textured(path)
        )

    kept = lru_cache(_MESHES_KEPT)(load), lru_cache(_TEXTURED_KEPT)(textured)
    return CadModels(by_class.get, *kept, broken, (open_models, folder, label_set_name, cache))


def _find_models(folder: Path, label_set_name: str) -> _ModelFiles:
    """The models of a folder in any of the three layouts."""
    if (folder / INDEX_NAME).is_file():
        labels = _labels_of_shards(folder, label_set_name)
        return _ModelFiles(labels, lambda model_id: model_path(folder, model_id), read_model)
    if folder.is_dir() and not any((folder / name).is_file() for name in INFO_FILES):
        return _own_models(folder, label_set_name)
    categories = model_categories(folder, "--models")
    labels = {m: class_of_category(name, label_set_name) for m, name in categories.items()}
    return _ModelFiles(labels, lambda m: folder / m / MODEL_FILE, read_obj, read_textured)


def _labels_of_shards(folder: Path, label_set_name: str) -> dict[str, str]:
    """Classes of the models in training rooms, as assigned by the recipe of the shards."""
    labels: dict[str, str] = {}
    for shard, room_id in iterate_rooms(folder, "train"):
        if shard.label_set != label_set_name:
            raise InputError(
                f"The rooms of {folder} have label set '{shard.label_set}', but the scenes have "
                f"'{label_set_name}'; give --models shards with the scenes' label set."
            )
        truth = shard.read_ground_truth(room_id)
        names = label_set(label_set_name)
        labels |= {
            model_id: names[label]
            for model_id, label in zip(truth.model_ids, truth.object_class, strict=True)
            if model_id  # ScanNet's objects have none
        }
    return labels


def _own_models(folder: Path, label_set_name: str) -> _ModelFiles:
    """Models in sub-folders by class; a folder with an unknown class name gives a warning."""
    labels = dict[str, str]()
    for home in list_folders(folder):
        files = [path for path in list_files(home) if path.suffix.lower() in (".glb", ".obj")]
        label = class_of_folder(home.name, label_set_name)
        if files and label is None:
            warnings.warn(
                f"{home} is left out, with {len(files)} models: its name is neither a class of "
                f"{label_set_name} nor a category of 3D-FUTURE; name it after its class, such as "
                f"{label_set(label_set_name)[1]}.",
                InputWarning,
                stacklevel=2,
            )
        labels |= {f"{home.name}/{path.name}": label or "void" for path in files}
    if not labels:
        raise InputError(
            f"{folder} has no model_info.json (a folder of 3D-FUTURE), no {INDEX_NAME} (shards), "
            "nor a sub-folder of a class with GLBs or OBJs; --models names one of them."
        )

    def read(path: Path) -> Mesh:
        return read_glb(path) if path.suffix.lower() == ".glb" else read_obj(path)

    return _ModelFiles(labels, lambda model_id: folder / model_id, read, read_textured)


def class_of_folder(name: str, label_set_name: str) -> str | None:
    """Class of the models in a folder, from the folder's name, which is a class of the label set or
    a 3D-FUTURE category. Upper case and underscores for spaces are allowed.

    `void` for a known class or category that the label set lacks; None for an unknown name.

        >>> class_of_folder("Double_Bed", "front3d_bedroom"), class_of_folder("king-size bed",
        ...     "front3d_bedroom")
        ('double_bed', 'double_bed')
        >>> class_of_folder("bathtub", "front3d_bedroom"), class_of_folder("unicorn", "scannet")
        ('void', None)
    """
    plain = _plain(name)
    if (label := {_plain(each): each for each in label_set(label_set_name)}.get(plain)) is not None:
        return label
    categories = {_plain(each): each for each in category_table()}
    if plain in categories:
        return class_of_category(categories[plain], label_set_name)
    return (
        "void" if plain in {_plain(each) for some in LABEL_SETS.values() for each in some} else None
    )


def _plain(name: str) -> str:
    # A folder's name has no slash: "bookcase_jewelry armoire" is "bookcase / jewelry armoire".
    return tidy_category(name).replace("_", " ").replace("/", " ")


def read_glb(path: Path) -> Mesh:
    """All meshes of a GLB as one, placed by its nodes.

    Raises:
        InputError: the file is damaged, or holds no triangles.
    """
    where = f"{path.parent.name}/{path.name}"
    try:
        parts = list(load_parts(path, "glb", with_materials=False).values())
    except Exception as error:  # a damaged file raises almost anything in trimesh
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        raise InputError(f"{where} cannot be read ({reason.rstrip('.')})") from None
    if not parts:
        raise InputError(f"{where} holds no usable triangles")
    return joined(parts)


def read_textured(path: Path) -> tuple[Textured, ...]:
    """The parts of a GLB or an OBJ with their materials; none if no part has one.

    Materials that cannot be read, such as those with a damaged image, are a warning.
    """
    try:
        parts = tuple(load_parts(path, path.suffix[1:].lower()).values())
    except Exception as error:  # a damaged file raises almost anything in trimesh
        warnings.warn(
            f"{path.parent.name}/{path.name} gets the colour of its class, because its materials "
            f"cannot be read ({type(error).__name__}: {error}).",
            InputWarning,
            stacklevel=2,
        )
        return ()
    return parts if any(part.material is not None for part in parts) else ()


# -- Points on surfaces ----------------------------------------------------------------------------


def _points_of_models(
    folder: Path, files: _ModelFiles, cached: Path
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Sample points of each model; returns them, and the reasons for broken models.

    The points are cached in an npz in the folder `cached`, even if sampling is interrupted.
    """
    settings = f"{folder.resolve()}|{POINTS}|{SEED}|{FORMAT}"
    kept = cached / f"points-{hashlib.sha256(settings.encode()).hexdigest()[:16]}.npz"
    file = kept_arrays(kept)
    before = dict(zip(file["keys"].tolist(), file["points"], strict=True)) if file else {}
    keys, broken = dict[str, str](), dict[str, str]()
    for model_id in sorted(m for m, label in files.labels.items() if label != "void"):
        try:
            if not all(map(is_name, model_id.split("/"))):
                raise InputError(f"{ascii(model_id)[:60]} cannot be a folder's name")
            keys[model_id] = _key_of(model_id, files)
        except InputError as error:
            broken[model_id] = str(error)
    points = {key: before[key] for key in keys.values() if key in before}
    try:
        new = [m for m, key in keys.items() if key not in points]
        console = Console(stderr=True, quiet=not new)
        for model_id in track(new, "reading models", console=console, transient=True):
            try:
                points[keys[model_id]] = _unit_samples(files.read(files.path_of(model_id)))
            except (InputError, ValueError) as error:
                broken[model_id] = str(error)
    finally:
        if points.keys() - before.keys():
            # Models of other label sets stay, too, as long as their files are the same.
            every = {key: own for key, own in before.items() if _is_current(key, files)} | points
            stacked = np.stack(list(every.values()))
            keep_arrays(kept, {"keys": np.array(list(every)), "points": stacked})
    return {m: points[key] for m, key in keys.items() if key in points}, broken


def _key_of(model_id: str, files: _ModelFiles) -> str:
    """A model and the version of its file."""
    return f"{model_id} {file_stamp(files.path_of(model_id))}"


def _is_current(key: str, files: _ModelFiles) -> bool:
    with contextlib.suppress(InputError):
        return _key_of(key.rpartition(" (")[0], files) == key
    return False


def _unit_samples(mesh: Mesh) -> Float[np.ndarray, "points 3"]:
    """Points on a surface, moved and scaled with it to the unit box.

    They are sampled before scaling, which would enlarge thin sides.
    """
    vertices = np.asarray(mesh.vertices_m, dtype=np.float64)
    points = surface_points(vertices, mesh.faces, POINTS, SEED)
    return _unit_points(points, vertices).astype(np.float32)


def unit_mesh(mesh: Mesh) -> Mesh:
    """Move and scale a mesh to fill [-0.5, 0.5]^3; a flat side becomes 0."""
    vertices = np.asarray(mesh.vertices_m, dtype=np.float64)
    return Mesh(_unit_points(vertices, vertices), mesh.faces)


def _unit_points(points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Points of a mesh, moved and scaled with it; see `unit_mesh`."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    sides = high - low
    scale = np.where(sides > _FLAT * sides.max(), 1 / np.maximum(sides, 1e-300), 0.0)
    return (points - (low + high) / 2) * scale

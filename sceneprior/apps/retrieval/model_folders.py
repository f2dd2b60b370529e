"""The files of CAD models in a folder, and their classes, in one of three layouts:

<folder>/model_info.json, <model id>/raw_model.obj      3D-FUTURE
<folder>/index.json, models/<model id>.ply              shards of `prep-front`
<folder>/<class>/<any name>.glb or .obj                 the user's own models
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sceneprior.core.classes import LABEL_SETS, label_set
from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.files import is_name
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
from sceneprior.core.scene import Mesh, Textured
from sceneprior.core.shards import INDEX_NAME, iterate_rooms
from sceneprior.render.model_files import joined, load_parts

OWN_FORMATS = (".glb", ".obj")


@dataclass(frozen=True)
class ModelFiles:
    """Files of the models of a label set's classes."""

    paths: Mapping[str, Path]
    """Path by model id, sorted by id."""
    labels: Mapping[str, str]
    """Class by model id; `void` if the label set has no class for it."""
    read: Callable[[Path], Mesh]
    textured: Callable[[Path], tuple[Textured, ...]] = lambda path: ()
    """Reads the parts of a model with their materials; none for models in class colours."""
    broken: Mapping[str, str] = field(default_factory=dict)
    """Ids that cannot be names of files, each with the reason."""


def find_models(folder: Path, label_set_name: str) -> ModelFiles:
    """The models of a folder in any of the three layouts.

    Raises:
        InputError: the folder is missing, or has none of the layouts.
    """
    if (folder / INDEX_NAME).is_file():
        labels = _labels_of_shards(folder, label_set_name)
        return _listed(labels, lambda model_id: model_path(folder, model_id), read_model)
    if folder.is_dir() and not any((folder / name).is_file() for name in INFO_FILES):
        if _own_folders(folder):
            return _own_models(folder, label_set_name)
        raise InputError(
            f"{folder} has no model_info.json (a folder of 3D-FUTURE), no {INDEX_NAME} (shards), "
            "nor a sub-folder of a class with GLBs or OBJs; --models names one of them."
        )
    categories = model_categories(folder, "--models")
    labels = {m: class_of_category(name, label_set_name) for m, name in categories.items()}
    return _listed(labels, lambda model_id: folder / model_id / MODEL_FILE, read_obj, read_textured)


def _listed(
    labels: Mapping[str, str],
    path_of: Callable[[str], Path],
    read: Callable[[Path], Mesh],
    textured: Callable[[Path], tuple[Textured, ...]] = lambda path: (),
) -> ModelFiles:
    wanted = sorted(model_id for model_id, label in labels.items() if label != "void")
    broken = {m: f"{ascii(m)[:60]} cannot be a folder's name" for m in wanted if not is_name(m)}
    paths = {m: path_of(m) for m in wanted if m not in broken}
    return ModelFiles(paths, labels, read, textured, broken)


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


def _own_folders(folder: Path) -> list[Path]:
    """Sub-folders that hold a GLB or an OBJ, sorted."""
    return sorted(path for path in folder.iterdir() if path.is_dir() and _own_files(path))


def _own_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in OWN_FORMATS)


def _own_models(folder: Path, label_set_name: str) -> ModelFiles:
    """Models in sub-folders by class; a folder with an unknown class name gives a warning."""
    labels, paths = {}, {}
    for home in _own_folders(folder):
        files = _own_files(home)
        label = class_of_folder(home.name, label_set_name)
        if label is None:
            warnings.warn(
                f"{home} is left out, with {len(files)} models: its name is neither a class of "
                f"{label_set_name} nor a category of 3D-FUTURE; name it after its class, such as "
                f"{label_set(label_set_name)[1]}.",
                InputWarning,
                stacklevel=2,
            )
            label = "void"
        for path in files:
            model_id = f"{home.name}/{path.name}"
            labels[model_id] = label
            if label != "void":
                paths[model_id] = path
    return ModelFiles(paths, labels, _read_own, read_textured)


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


def _read_own(path: Path) -> Mesh:
    return read_glb(path) if path.suffix.lower() == ".glb" else read_obj(path)


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

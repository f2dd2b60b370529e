"""Reads furniture models in 3D-FUTURE's layout: their categories, classes and meshes.

    <folder>/model_info.json        or model_info_revised.json: the category of each model
    <folder>/<model id>/raw_model.obj

It is used to prepare rooms and to retrieve CAD models for generated rooms.
"""

import csv
import functools
import re
from pathlib import Path

import numpy as np

from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_bytes, read_json
from sceneprior.core.scene import Mesh

MODEL_FILE = "raw_model.obj"
INFO_FILES = ("model_info.json", "model_info_revised.json")


def model_info_path(folder: Path, option: str = "--future") -> Path:
    """Path of 3D-FUTURE's list of models; `option` is the command-line option named in errors."""
    if not folder.is_dir():
        raise InputError(f"No folder at {folder}; {option} names the folder of 3D-FUTURE models.")
    for name in INFO_FILES:
        if (folder / name).is_file():
            return folder / name
    raise InputError(
        f"{folder} has no model_info.json (nor model_info_revised.json), so it is not a folder "
        f"of 3D-FUTURE models; {option} usually ends in 3D-FUTURE-model."
    )


def model_categories(folder: Path, option: str = "--future") -> dict[str, str]:
    """Category of each model id, as `tidy_category` writes it; "others" if the release has null."""
    path = model_info_path(folder, option)
    data = read_json(path)
    try:
        categories = {str(row["model_id"]): row.get("category") for row in data}
    except (TypeError, KeyError, AttributeError) as error:
        raise InputError(
            f"{path} is not 3D-FUTURE's list of models ({type(error).__name__}: {error})."
        ) from None
    return {
        model_id: "others" if text is None else tidy_category(str(text))
        for model_id, text in categories.items()
    }


def tidy_category(text: str) -> str:
    """Normalise a category as in `category_table`: lower case, and "a/b" for "a / b"."""
    return text.strip().lower().replace(" / ", "/")


_COLUMNS = {
    "front3d_bedroom": ("bedroom_class",),
    "front3d_living": ("living_room_class",),
    "front3d_dining": ("living_room_class",),
    "front3d_library": ("living_room_class",),
}


@functools.cache
def category_table() -> dict[str, dict[str, str]]:
    """Rows of front3d_categories.csv, by category of 3D-FUTURE.

    A row holds the class that the category has in bedrooms (`bedroom_class`) and in living rooms
    (`living_room_class`).
    """
    with Path(__file__).with_name("front3d_categories.csv").open(newline="") as file:
        return {row["model_info_category"]: row for row in csv.DictReader(file)}


def class_of_category(category: str, label_set_name: str) -> str:
    """Class of a category in a label set; `void` if it has none.

    The label sets of 3D-FRONT follow the paper's table. In any other label set, the class is the
    first of these names that the label set contains: the category, its class in bedrooms, its class
    in living rooms.

        >>> class_of_category("king-size bed", "front3d_bedroom")
        'double_bed'
        >>> class_of_category("dining table", "void,sink,table")
        'table'
    """
    names = label_set(label_set_name)
    if label_set_name not in _COLUMNS and category in names:
        return category
    row = category_table().get(category, {})
    for column in _COLUMNS.get(label_set_name, ("bedroom_class", "living_room_class")):
        found = row.get(column, "void")
        if found != "void" and found in names:
            return found
    return "void"


def obj_text(path: Path) -> str:
    """Read an OBJ as readers expect it, who know neither byte order marks, tabs, indents, continued
    lines and comments behind numbers, nor indices that count back from the line in which they
    stand."""
    text = read_bytes(path).decode("utf-8-sig", errors="replace").replace("\t", " ")
    text = re.sub(r"\\ *\n", " ", text.replace("\r\n", "\n").replace("\r", "\n"))
    text = _REMARK.sub(r"\1", text) if "#" in text else text
    if not _UNUSUAL.search(text):
        return text
    number = dict.fromkeys(("v", "vt", "vn"), 0)
    lines = []
    for line in map(str.strip, text.splitlines()):
        head, _, rest = line.partition(" ")
        if head in number:
            number[head] += 1
        elif head in ("f", "l", "p") and "-" in rest:
            corners = [
                "/".join(
                    str(int(index) + 1 + count) if index.startswith("-") else index
                    for index, count in zip(corner.split("/"), number.values(), strict=False)
                )
                for corner in rest.split()
            ]
            line = " ".join([head, *corners])
        lines.append(line)
    return "\n".join(lines)


_REMARK = re.compile(r"^( *(?:v|vt|vn|f) [^#\n]*)#.*", re.MULTILINE)
_UNUSUAL = re.compile(r"^ +\S|^[flp] .*-\d", re.MULTILINE)


def read_obj(path: Path) -> Mesh:
    """Read the triangles of a Wavefront OBJ, without materials, normals and unused vertices."""
    vertices: list[list[str]] = []
    polygons: list[list[str]] = []
    try:
        for line in obj_text(path).splitlines():
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
        faces = np.array(corners, dtype=np.int64).reshape(-1, 3) - 1  # OBJ indices start at 1
        used, faces = np.unique(faces, return_inverse=True)
        points = points[used]
    except (ValueError, IndexError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path.parent.name}/{path.name} cannot be read ({error})") from None
    if not len(used) or used[0] < 0 or not np.isfinite(points).all():
        raise InputError(f"{path.parent.name}/{path.name} holds no usable triangles")
    return Mesh(points, faces.reshape(-1, 3).astype(np.int32))

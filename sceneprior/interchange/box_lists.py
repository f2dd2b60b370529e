"""Box lists in ATISS's format: those of other methods become scenes, and scenes are written."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import list_files, read_arrays, read_json, write_whole
from sceneprior.core.scene import Mesh, Scene, SceneObject, Turned, bound_m
from sceneprior.core.scene_json import MOST_OBJECTS, check_box
from sceneprior.core.shell import floor_polygon
from sceneprior.interchange.floors import FLOOR, floor_outline, floor_plan
from sceneprior.render.appearance import box_mesh

NEEDED = ("class_labels", "translations", "sizes", "angles")
NOT_FURNITURE = ("start", "empty", "void")
"""Columns of `class_labels` that stand for no object; the column `end` ends the list."""
ENDS = ("start", "end")
"""Columns that ATISS appends to the class columns."""
SIZES = {"half": 2.0, "full": 1.0}
"""Factors from sizes in a file to full extents."""
_QUARTER_RAD = 1e-4
"""Tolerance within which an angle counts as a quarter turn; such boxes need no mesh."""


def read_box_lists(
    boxes: Path, label_set_name: str, classes: str | None = None, sizes: str = "half"
) -> list[Scene]:
    """Read the rooms of box lists.

    A file is an `.npz` with one room (arrays over objects) or several (one more leading axis), or a
    `.json` with one such record, or a list of records. If a file holds several rooms, a number is
    appended to each room's name.

    Args:
        boxes: A `.npz` or `.json`, or a folder that is searched for them: ATISS stores a folder
            with a boxes.npz per room.
        classes: Comma-separated names of the columns (or indices) of `class_labels`; None takes
            the label set without void, followed by `start` and `end` if there are two more columns.
        sizes: `half` or `full` extents.
    """
    if sizes not in SIZES:
        raise InputError(f"No sizes '{sizes}'; expected half (half extents, as in ATISS) or full.")
    columns = None if classes is None else [name.strip() for name in classes.split(",")]
    boxes = Path(boxes)
    files = {boxes: boxes.stem}
    if not boxes.is_file():
        found = [p for p in list_files(boxes, deep=True) if p.suffix in (".npz", ".json")]
        parts = (path.relative_to(boxes).with_suffix("").parts for path in found)
        files = {
            path: "_".join(some).removesuffix("_boxes")
            for path, some in zip(found, parts, strict=True)
        }
    if not files:
        raise InputError(f"{boxes} holds no .npz and no .json; give box lists of ATISS's format.")
    scenes = []
    for path, name in files.items():
        rooms = [room for record in _records(path) for room in _one_by_one(path, record)]
        for row, room in enumerate(rooms):
            objects = tuple(_objects(path, room, label_set_name, columns, SIZES[sizes]))
            if len(objects) > MOST_OBJECTS:
                raise InputError(
                    f"{path}: a room has {len(objects)} objects; expected at most {MOST_OBJECTS}."
                )
            own = name if len(rooms) == 1 else f"{name}_{row:04d}"
            floor_m, extra = floor_outline(path, room), {"converted_from": path.name}
            scenes.append(Scene(own, label_set_name, objects, floor_m, extra))
    return scenes


def _records(path: Path) -> list[dict[str, Any]]:
    hint = f"expected a box list, an .npz or .json with {', '.join(NEEDED)}"
    if path.suffix == ".npz":
        records = [read_arrays(path, hint, (*NEEDED, *FLOOR))]
    else:
        loaded = read_json(path, hint=hint)
        records = loaded if isinstance(loaded, list) else [loaded]
    if not all(isinstance(record, dict) for record in records):
        raise InputError(f"{path} is not a box list; expected objects with {', '.join(NEEDED)}.")
    missing = [key for key in NEEDED if any(key not in record for record in records)]
    if missing:
        raise InputError(f"{path} has no {' and no '.join(missing)}; a box list has all of them.")
    return records


def _one_by_one(path: Path, record: dict[str, Any]) -> list[dict[str, Any]]:
    """Split a record into single rooms. Its arrays have one row per object; if the record holds
    several rooms, the rooms are an additional first axis."""
    try:
        labels, *boxes = (np.asarray(record[key]) for key in NEEDED)
        centers, sizes, angles = (part.astype(np.float64, casting="same_kind") for part in boxes)
    except (ValueError, TypeError, OverflowError):
        raise InputError(
            f"{path}: class_labels, translations, sizes and angles must be arrays, the last three "
            "of numbers."
        ) from None
    if centers.size == 0:
        centers, sizes, angles = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
        labels = np.zeros(0, dtype=int)
    if angles.ndim == centers.ndim and angles.shape[-1:] == (1,):
        angles = angles[..., 0]
    objects = centers.shape[:-1]
    if (
        centers.ndim not in (2, 3)
        or centers.shape[-1] != 3
        or sizes.shape != centers.shape
        or angles.shape != objects
        or labels.shape[: len(objects)] != objects
        or labels.ndim > len(objects) + 1
    ):
        raise InputError(
            f"{path}: class_labels {labels.shape}, translations {centers.shape}, sizes "
            f"{sizes.shape} and angles {angles.shape} do not describe the same objects; expected "
            "(objects, classes), (objects, 3), (objects, 3) and (objects, 1)."
        )
    if not all(np.isfinite(array).all() for array in (centers, sizes, angles)):
        raise InputError(f"{path} holds numbers that are not finite; leave such rooms out.")
    arrays = dict(zip(NEEDED, (labels, centers, sizes, angles), strict=True))
    if centers.ndim == 2:
        return [arrays | {key: record[key] for key in FLOOR if key in record}]
    return [{key: array[row] for key, array in arrays.items()} for row in range(len(centers))]


def _objects(
    path: Path,
    room: dict[str, Any],
    label_set_name: str,
    columns: Sequence[str] | None,
    size_factor: float,
) -> Iterator[SceneObject]:
    known = label_set(label_set_name)
    labels = room["class_labels"]
    if labels.dtype.kind not in "US" or labels.ndim != 1:
        labels = _label_names(path, labels, columns or known[1:], columns is None)
    for label, center, size, angle in zip(labels, *(room[key] for key in NEEDED[1:]), strict=True):
        if label == "end":
            break
        if label is None:
            raise InputError(f"{path}: a row of class_labels has no class; leave that object out.")
        if label in NOT_FURNITURE:
            continue
        if label not in known:
            raise InputError(
                f"{path}: class '{label}' is not in label set '{label_set_name}'; use one of "
                f"{', '.join(known[1:])}, or another --label-set."
            )
        check_box(path, label, center.tolist(), (size_factor * size).tolist())
        yield turned_box(str(label), center, size_factor * size, float(angle))


def _label_names(
    path: Path, labels: np.ndarray, columns: Sequence[str], may_have_ends: bool
) -> list[str | None]:
    """Names of class indices or one-hot rows; None for rows of zeros, or with NaN."""
    if labels.dtype.kind not in "fiub" or labels.shape[1:] == (0,):
        raise InputError(f"{path}: class_labels are neither names, indices nor one-hot rows.")
    one_hot = labels.ndim == 2
    rows = labels.argmax(-1) if one_hot else labels.astype(int)
    wide = labels.shape[1] if one_hot else int(rows.max(initial=-1)) + 1
    if may_have_ends and one_hot and wide == len(columns) + 2:
        columns = [*columns, *ENDS]
    if (one_hot and wide != len(columns)) or wide > len(columns) or (rows < 0).any():
        raise InputError(
            f"{path}: class_labels have {wide} columns, but there are {len(columns)} names; give "
            "all names in order with --classes, including start, end and empty."
        )
    blank = (labels == 0).all(-1) | (labels != labels).any(-1) if one_hot else rows < 0
    return [None if without else columns[row] for row, without in zip(rows, blank, strict=True)]


def turned_box(
    label: str, center: Float[np.ndarray, "3"], size: Float[np.ndarray, "3"], yaw_rad: float
) -> SceneObject:
    """Build a `SceneObject` from a box rotated about +y by `yaw_rad`, which turns +z towards +x.

    The object has the axis-aligned box around the turned one, which is kept as `turned`. Unless the
    angle is a quarter turn, the object's mesh is the turned box, so that pictures show it.

    Example: a square table, 1 m wide, turned by 45 degrees.

        >>> turned = turned_box("table", np.zeros(3), np.array([1.0, 0.7, 1.0]), np.pi / 4)
        >>> [round(float(side), 3) for side in turned.size_m]
        [1.414, 0.7, 1.414]
    """
    width, height, depth = map(float, size)
    turned = Turned(yaw_rad, (width, height, depth))
    x, y, z = map(float, center)
    item = SceneObject(label, (x, y, z), bound_m(turned), turned=turned if yaw_rad else None)
    if abs(yaw_rad - np.round(yaw_rad / (np.pi / 2)) * (np.pi / 2)) < _QUARTER_RAD:
        return item
    own = box_mesh((0.0, 0.0, 0.0), turned.size_m)
    return replace(item, mesh=Mesh(own.vertices_m @ yaw_rotation(yaw_rad).T + center, own.faces))


def write_atiss(scenes: Sequence[Scene], folder: Path) -> None:
    """Write `<room>/boxes.npz` for each room, y up, in metres, with the floor's centre as origin.

    Sizes are half extents in the box's own frame. An object with a turned box is written with that
    box; any other object with its axis-aligned box and angle 0. Meshes are not written. The columns
    of `class_labels` are the label set without void, then `start` and `end`.
    """
    for scene in scenes:
        columns = [name for name in label_set(scene.label_set) if name not in NOT_FURNITURE]
        one_hot = np.eye(len(columns) + len(ENDS), dtype=np.float32)
        rows = [columns.index(item.label) for item in scene.objects]
        boxes = [item.turned or Turned(0.0, item.size_m) for item in scene.objects]
        outline = floor_polygon(scene)
        floor: dict[str, Any] = {} if outline is None else floor_plan(outline)
        buffer = io.BytesIO()
        np.savez(
            buffer,
            class_labels=one_hot[np.array(rows, dtype=int)],
            translations=scene.centers_m,
            sizes=np.array([box.size_m for box in boxes]).reshape(-1, 3) / 2,
            angles=np.array([box.yaw_rad for box in boxes]).reshape(-1, 1),
            **floor,
        )
        write_whole(Path(folder) / scene.name / "boxes.npz", buffer.getvalue())

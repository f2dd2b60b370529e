"""Box lists in ATISS's format: those of other methods become scenes, and scenes are written."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float

from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json, write_whole
from sceneprior.core.scene import Mesh, Scene, SceneObject, Turned, bound_m
from sceneprior.core.scene_json import MOST_OBJECTS, check_box, check_floor
from sceneprior.core.shell import floor_polygon
from sceneprior.render.appearance import box_mesh

NEEDED = ("class_labels", "translations", "sizes", "angles")
FLOOR = ("floor_plan_vertices", "floor_plan_faces", "floor_plan_centroid")
NOT_FURNITURE = ("start", "empty", "void")
"""Columns of `class_labels` that stand for no object; the column `end` ends the list."""
SIZES = {"half": 2.0, "full": 1.0}
_QUARTER_RAD = 1e-4
"""Tolerance within which an angle counts as a quarter turn; such boxes need no mesh."""


def read_box_lists(
    boxes: Path, label_set_name: str, classes: str | None = None, sizes: str = "half"
) -> list[Scene]:
    """Read the rooms of box lists.

    Args:
        boxes: A `.npz` or `.json`, or a folder that is searched for them.
        classes: Comma-separated names of the columns (or indices) of `class_labels`; None takes
            the label set without void, followed by `start` and `end` if there are two more columns.
        sizes: `half` or `full` extents.
    """
    if sizes not in SIZES:
        raise InputError(f"No sizes '{sizes}'; expected half (half extents, as in ATISS) or full.")
    columns = None if classes is None else [name.strip() for name in classes.split(",")]
    return [
        scene
        for path, name in _files(Path(boxes))
        for scene in read_boxes(path, name, label_set_name, columns, SIZES[sizes])
    ]


def _files(boxes: Path) -> list[tuple[Path, str]]:
    """Box-list files, each with a room name: ATISS stores a folder with a boxes.npz per room."""
    if boxes.is_file():
        return [(boxes, boxes.stem)]
    found = [path for path in sorted(boxes.rglob("*")) if path.suffix in (".npz", ".json")]
    if not found:
        raise InputError(f"{boxes} holds no .npz and no .json; give box lists of ATISS's format.")
    return [
        (path, "_".join(path.relative_to(boxes).with_suffix("").parts).removesuffix("_boxes"))
        for path in found
    ]


def read_boxes(
    path: Path,
    name: str,
    label_set_name: str,
    columns: Sequence[str] | None = None,
    size_factor: float = 2.0,
) -> list[Scene]:
    """Read the rooms of one file; see `read_box_lists`. If the file holds several rooms, a number
    is appended to each room's name.

    Args:
        path: `.npz` with one room (arrays over objects) or several (one more leading axis), or
            `.json` with one such record, or a list of records.
        size_factor: Factor from `sizes` to full extents.
    """
    rooms = [room for record in _records(path) for room in _one_by_one(path, record)]
    scenes = []
    for row, room in enumerate(rooms):
        own = name if len(rooms) == 1 else f"{name}_{row:04d}"
        objects = tuple(_objects(path, room, label_set_name, columns, size_factor))
        if len(objects) > MOST_OBJECTS:
            raise InputError(
                f"{path}: a room has {len(objects)} objects; expected at most {MOST_OBJECTS}."
            )
        come_from = {"converted_from": path.name}
        scenes.append(Scene(own, label_set_name, objects, floor_outline(path, room), come_from))
    return scenes


def _records(path: Path) -> list[dict[str, Any]]:
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                records = [{key: file[key] for key in (*NEEDED, *FLOOR) if key in file}]
        else:
            loaded = read_json(path)
            records = loaded if isinstance(loaded, list) else [loaded]
    except Exception as error:  # a damaged file raises almost anything in numpy
        raise InputError(
            f"{path} is not a box list ({type(error).__name__}); expected an .npz or .json with "
            f"{', '.join(NEEDED)}."
        ) from None
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
    if angles.ndim == centers.ndim and angles.shape[-1] == 1:
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
    labels = _label_names(path, room["class_labels"], known, columns)
    boxes = (room[key] for key in NEEDED[1:])
    for label, center, size, angle in zip(labels, *boxes, strict=True):
        if label == "end":
            break
        if label in NOT_FURNITURE:
            continue
        if label not in known:
            raise InputError(
                f"{path}: class '{label}' is not in label set '{label_set_name}'; use one of "
                f"{', '.join(known[1:])}, or another --label-set."
            )
        check_box(path, label, center.tolist(), (size_factor * size).tolist())
        yield turned_box(label, center, size_factor * size, float(angle))


def _label_names(
    path: Path, labels: np.ndarray, known: Sequence[str], columns: Sequence[str] | None
) -> list[str]:
    if labels.dtype.kind in "US":
        return [str(label) for label in labels]
    if labels.dtype.kind not in "fiub" or labels.shape[1:] == (0,):
        raise InputError(f"{path}: class_labels are neither names, indices nor one-hot rows.")
    rows = labels.argmax(-1) if labels.ndim == 2 else labels.astype(int)
    if columns is None:
        columns = known[1:]
        if labels.ndim == 2 and labels.shape[1] == len(columns) + 2:
            columns = [*columns, "start", "end"]
    wide = labels.shape[1] if labels.ndim == 2 else int(rows.max(initial=-1)) + 1
    if (labels.ndim == 2 and wide != len(columns)) or wide > len(columns) or (rows < 0).any():
        raise InputError(
            f"{path}: class_labels have {wide} columns, but there are {len(columns)} names; give "
            "all names in order with --classes, including start, end and empty."
        )
    return [columns[row] for row in rows]


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


def floor_outline(path: Path, room: dict[str, Any]) -> np.ndarray | None:
    """Outline of the floor's triangles relative to its centroid, the origin of ATISS's boxes."""
    if any(key not in room for key in FLOOR):
        return None
    try:
        vertices, faces, centroid = (np.asarray(room[key]) for key in FLOOR)
        flat = (vertices.astype(np.float64) - centroid)[:, [0, 2]]
        check_floor(path, flat)
        # buffer(0) makes the triangles valid, so that their union is one outline.
        floor = shapely.union_all([shapely.Polygon(flat[face]).buffer(0) for face in faces])
        largest = max(shapely.get_parts(floor), key=shapely.area)
        return np.asarray(largest.exterior.coords)[:-1]
    except InputError:
        raise
    except (ValueError, IndexError, TypeError, OverflowError, shapely.errors.ShapelyError) as error:
        raise InputError(
            f"{path}: its floor plan cannot be read ({error}); expected vertices (V, 3), "
            "triangles (F, 3) and a centroid (3,)."
        ) from None


ENDS = ("start", "end")
"""Columns that ATISS appends to the class columns."""


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


def floor_plan(floor: shapely.Geometry) -> dict[str, np.ndarray]:
    """Convert a floor polygon to ATISS's arrays: triangles at y = 0 that face up, and the origin as
    centroid.

    >>> floor_plan(shapely.box(-1, -1, 1, 1))["floor_plan_faces"].shape
    (2, 3)
    """
    # A polygon with repeated corners cannot be triangulated.
    floor = shapely.remove_repeated_points(floor)
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(floor))
    # Counter-clockwise in (x, z) faces down with y up, so the order is reversed.
    corners = [np.asarray(shapely.orient_polygons(part).exterior.coords)[2::-1] for part in parts]
    flat = np.concatenate(corners)
    return {
        "floor_plan_vertices": np.stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]], axis=1),
        "floor_plan_faces": np.arange(len(flat)).reshape(-1, 3),
        "floor_plan_centroid": np.zeros(3),
    }

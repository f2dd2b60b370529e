"""A nerfstudio-style transforms.json in; frames with poses, intrinsics and the files beside them out.

Read, of the file: `frames`; lens keys (below) for all frames; `floor_m`, `floor_center_m`,
`metres_per_unit`. Of a frame: `file_path`, `transform_matrix`, `instance_path`, `mask_path`, and
lens keys, which win over the file's. Lens keys: `fl_x fl_y cx cy w h camera_angle_x
camera_angle_y`; and `k1 k2 k3 k4 p1 p2 camera_model is_fisheye`, to refuse what is no pinhole. All
others are passed over, and the pictures themselves are never opened.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.errors import InputError

FILE_NAME = "transforms.json"
INSTANCES = "instances"
_PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".exr", ".tif", ".tiff", ".bmp", ".heic")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_STRAIGHT = 1e-6
"""A distortion this small moves no point by a thousandth of a pixel."""
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_UNDISTORT = (
    "; undistort the pictures first (`colmap image_undistorter` does), draw the masks on those, "
    "and write their pinhole lens"
)


@dataclass(frozen=True)
class PosedFrame:
    """One frame of the file."""

    name: str
    """Its `file_path`, for messages."""
    camera_to_world: np.ndarray
    """(4, 4) float64 as written: OpenGL axes (x right, y up, z backward), the file's units."""
    instances: Path
    """PNG of tracked ids; it may be missing."""
    known: Path | None
    """PNG that is 0 where nothing is known, from `mask_path`."""
    lens: dict[str, float]
    """The lens keys that are given, the frame's own before the file's."""


@dataclass(frozen=True)
class Recording:
    """What a transforms.json says."""

    path: Path
    frames: tuple[PosedFrame, ...]
    floor_m: float | None
    """Height of the floor along the up axis, metres."""
    floor_center_m: tuple[float, float] | None
    """Of the floor, along the two level axes in their order, metres."""
    metres_per_unit: float | None


def read_transforms(folder: Path) -> Recording:
    """Read one room's transforms.json.

    Raises:
        InputError: the file is missing, not JSON, misses a key or has one of a wrong type, or its
            lens is not a pinhole's; the message names the file, the frame and the key.
    """
    path = Path(folder) / FILE_NAME
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not JSON ({str(error)[:120]}).") from None
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise InputError(f"{path} has no list `frames` with a frame in it.")
    frames = tuple(_frame(path, data, number) for number in range(len(data["frames"])))
    first: dict[Path, str] = {}
    for frame in frames:
        other = first.setdefault(frame.instances, frame.name)
        if other is not frame.name:
            raise InputError(
                f"{path}: frames '{other}' and '{frame.name}' would share the ids in "
                f"{frame.instances}; give each an `instance_path`."
            )
    scale = _number(data, "metres_per_unit", str(path))
    if scale is not None and scale <= 0:
        raise InputError(f"{path}: metres_per_unit is {scale}; it must be above 0.")
    return Recording(
        path, frames, _number(data, "floor_m", str(path)), _center(path, data), scale
    )  # fmt: skip


def room_name(folder: Path) -> str:
    """What a room is called: its folder, also where that was given as `.`."""
    name = Path(folder).name
    return name if name not in ("", "..") else Path(folder).resolve().name


def lens_matrix(
    frame: PosedFrame, mask_size: tuple[int, int]
) -> tuple[np.ndarray, tuple[int, int]]:
    """The pinhole of a frame and the size of the picture that it belongs to.

    `w`, `h` default to the size of the mask; `cx`, `cy` to the middle; `fl_x` to what
    `camera_angle_x` says; `fl_y` to `camera_angle_y`, else to square pixels. Pixel centres are at
    i + 0.5, as in nerfstudio and COLMAP, and as here.

    Args:
        frame: Its lens.
        mask_size: (height, width) of its PNG of ids.

    Returns:
        (3, 3) float64 in pixels, and (height, width).

    Raises:
        InputError: there is no focal length, or a value is out of range.
    """
    lens = frame.lens
    width, height = lens.get("w", mask_size[1]), lens.get("h", mask_size[0])
    if width < 1 or height < 1 or width % 1 or height % 1:
        raise InputError(f"frame '{frame.name}': w, h are {width}, {height}; expected pixel counts")
    fl_x = lens.get("fl_x") or _focal(lens.get("camera_angle_x"), width)
    if fl_x is None:
        raise InputError(
            f"frame '{frame.name}' has no fl_x and no camera_angle_x, here or for the whole file"
        )
    fl_y = lens.get("fl_y") or _focal(lens.get("camera_angle_y"), height) or fl_x
    if fl_x <= 0 or fl_y <= 0:
        raise InputError(f"frame '{frame.name}': fl_x, fl_y are {fl_x}, {fl_y}; expected above 0")
    cx, cy = lens.get("cx", width / 2), lens.get("cy", height / 2)
    return np.array([[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1.0]]), (int(height), int(width))


def _focal(angle_rad: float | None, side: float) -> float | None:
    if angle_rad is None or not 0 < angle_rad < math.pi:
        return None
    return side / 2 / math.tan(angle_rad / 2)


def _frame(path: Path, data: dict[str, Any], number: int) -> PosedFrame:
    item = data["frames"][number]
    if not isinstance(item, dict) or not isinstance(item.get("file_path"), str):
        raise InputError(f"{path}, frame {number}: it has no `file_path`.")
    name = item["file_path"]
    where = f"{path}, frame '{name}'"
    _refuse_bent(where, {**data, **item})
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y")
    lens = {}
    for key in keys:
        value = _number(item, key, where)
        if value is None:
            value = _number(data, key, str(path))
        if value is not None:
            lens[key] = value
    stem = Path(name)
    ids = f"{INSTANCES}/{stem.stem if stem.suffix.lower() in _PICTURES else stem.name}.png"
    return PosedFrame(
        name,
        _matrix(where, item.get("transform_matrix")),
        path.parent / _text(item, "instance_path", where, ids),
        path.parent / _text(item, "mask_path", where) if "mask_path" in item else None,
        lens,
    )


def _matrix(where: str, value: Any) -> np.ndarray:
    """(4, 4); a row (0, 0, 0, 1) that is left out is added. NaN may be in it: a lost pose."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape == (3, 4):
        matrix = np.concatenate([matrix, [[0, 0, 0, 1]]])
    if matrix.shape != (4, 4):
        raise InputError(f"{where}: `transform_matrix` is not a list of 4 rows of 4 numbers.")
    return matrix


def _refuse_bent(where: str, values: dict[str, Any]) -> None:
    for key in _DISTORTION:
        value = _number(values, key, where)
        if value is not None and abs(value) > _STRAIGHT:
            raise InputError(f"{where}: its lens is distorted ({key} = {value:g}){_UNDISTORT}.")
    model = values.get("camera_model", "PINHOLE")
    if values.get("is_fisheye") or str(model).upper() not in _PINHOLES:
        kind = "fisheye" if values.get("is_fisheye") else str(model)[:40]
        raise InputError(f"{where}: its camera_model is {kind}, not a pinhole{_UNDISTORT}.")


def _number(values: dict[str, Any], key: str, where: str) -> float | None:
    value = values.get(key)
    if value is None:
        return None
    # An int may be larger than any float.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e12:
        raise InputError(f"{where}: {key} is {str(value)[:40]!r}; expected a number.")
    return float(value)


def _text(values: dict[str, Any], key: str, where: str, default: str = "") -> str:
    value = values.get(key, default)
    if not isinstance(value, str) or not value or "\0" in value:
        raise InputError(f"{where}: {key} is {str(value)[:40]!r}; expected a path.")
    return value


def _center(path: Path, data: dict[str, Any]) -> tuple[float, float] | None:
    value = data.get("floor_center_m")
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"{path}: floor_center_m is {str(value)[:40]!r}; expected two numbers.")
    first, second = (_number({"floor_center_m": v}, "floor_center_m", str(path)) for v in value)
    if first is None or second is None:
        raise InputError(f"{path}: floor_center_m holds null; expected two numbers.")
    return first, second

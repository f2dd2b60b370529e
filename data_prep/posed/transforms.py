"""Reads a nerfstudio-style transforms.json: frames with poses, intrinsics, and the files beside it.

Read, of the file: `frames`; camera keys (see Camera) for all frames; `floor_m`, `floor_center_m`,
`metres_per_unit`. Of a frame: `file_path`, `transform_matrix`, `instance_path`, `mask_path`, and
camera keys, which win over the file's. All others are passed over, and the pictures themselves are
never opened.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from sceneprior.errors import InputError
from sceneprior.files import read_json

FILE_NAME = "transforms.json"
INSTANCES = "instances"
_PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".exr", ".tif", ".tiff", ".bmp", ".heic")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_STRAIGHT = 1e-6
"""A distortion this small moves no point by a thousandth of a pixel."""
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_UNDISTORT = (
    "; undistort the pictures first (`colmap image_undistorter` does), draw the masks on those, "
    "and write their pinhole intrinsics"
)

Number = Annotated[float, Field(gt=-1e12, lt=1e12)]
PathText = Annotated[str, Field(min_length=1, pattern=r"^[^\x00]*$")]


class Camera(BaseModel):
    """The camera keys of a frame, or of a file for all its frames."""

    model_config = ConfigDict(strict=True, frozen=True)

    fl_x: Number | None = None
    fl_y: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    w: Number | None = None
    h: Number | None = None
    camera_angle_x: Number | None = None
    camera_angle_y: Number | None = None
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0
    camera_model: Any = "PINHOLE"
    is_fisheye: Any = False

    @model_validator(mode="after")
    def _is_a_pinhole(self) -> "Camera":
        for key in _DISTORTION:
            if abs(value := getattr(self, key)) > _STRAIGHT:
                raise ValueError(f"its lens is distorted ({key} = {value:g}){_UNDISTORT}.")
        if self.is_fisheye or str(self.camera_model).upper() not in _PINHOLES:
            kind = "fisheye" if self.is_fisheye else str(self.camera_model)[:40]
            raise ValueError(f"its camera_model is {kind}, not a pinhole{_UNDISTORT}.")
        return self


class _FrameEntry(Camera):
    instance_path: PathText | None = None
    mask_path: PathText | None = None


class _FileEntry(BaseModel):
    model_config = ConfigDict(strict=True)

    floor_m: Number | None = None
    floor_center_m: Annotated[tuple[Number, Number], Field(strict=False)] | None = None
    metres_per_unit: Annotated[Number, Field(gt=0)] | None = None


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
    camera: Camera
    """The frame's own keys before the file's."""


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
    if not path.is_file() and (parts := split_files(folder)):
        raise InputError(
            f"{path} is missing: join the `frames` of {', '.join(parts)} in one file of that name."
        )
    data = read_json(path)
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
    room = _checked(_FileEntry, data, str(path))
    return Recording(path, frames, room.floor_m, room.floor_center_m, room.metres_per_unit)


def split_files(folder: Path) -> list[str]:
    """Names such as transforms_train.json, in which some tools keep the frames of each split."""
    return sorted(path.name for path in Path(folder).glob("transforms_*.json"))


def room_name(folder: Path) -> str:
    """What a room is called: its folder, also where that was given as `.`."""
    name = Path(folder).name
    return name if name not in ("", "..") else Path(folder).resolve().name


def frame_intrinsics(
    frame: PosedFrame, mask_size: tuple[int, int]
) -> tuple[np.ndarray, tuple[int, int]]:
    """The pinhole of a frame and the size of the picture that it belongs to.

    `w`, `h` default to the (height, width) of the mask, `mask_size`; `cx`, `cy` to the middle;
    `fl_x` to what `camera_angle_x` says; `fl_y` to `camera_angle_y`, else to square pixels. Pixel
    centres are at i + 0.5, as in nerfstudio and COLMAP, and as here.

    Returns:
        (3, 3) float64 in pixels, and (height, width).

    Raises:
        InputError: there is no focal length, or a value is out of range.
    """
    camera = frame.camera
    width = mask_size[1] if camera.w is None else camera.w
    height = mask_size[0] if camera.h is None else camera.h
    if width < 1 or height < 1 or width % 1 or height % 1:
        raise InputError(f"frame '{frame.name}': w, h are {width}, {height}; expected pixel counts")
    fl_x = camera.fl_x or _focal(camera.camera_angle_x, width)
    if fl_x is None:
        raise InputError(
            f"frame '{frame.name}' has no fl_x and no camera_angle_x, here or for the whole file"
        )
    fl_y = camera.fl_y or _focal(camera.camera_angle_y, height) or fl_x
    if fl_x <= 0 or fl_y <= 0:
        raise InputError(f"frame '{frame.name}': fl_x, fl_y are {fl_x}, {fl_y}; expected above 0")
    cx = width / 2 if camera.cx is None else camera.cx
    cy = height / 2 if camera.cy is None else camera.cy
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
    own = {key: value for key, value in item.items() if value is not None}
    of_file = {key: data[key] for key in Camera.model_fields if data.get(key) is not None}
    entry = _checked(_FrameEntry, of_file | own, where)
    stem = Path(name)
    ids = f"{INSTANCES}/{stem.stem if stem.suffix.lower() in _PICTURES else stem.name}.png"
    return PosedFrame(
        name,
        _matrix(where, item.get("transform_matrix")),
        path.parent / (entry.instance_path or ids),
        path.parent / entry.mask_path if entry.mask_path else None,
        entry,
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


_M = TypeVar("_M", bound=BaseModel)


def _checked(model: type[_M], data: dict[str, Any], where: str) -> _M:
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["type"] == "value_error":
            raise InputError(f"{where}: {first['ctx']['error']}") from None
        key, reason = ".".join(map(str, first["loc"])), first["msg"]
        raise InputError(
            f"{where}: {key} is {str(first['input'])[:40]!r}; {reason[:1].lower()}{reason[1:]}."
        ) from None

"""What a posed room's files say, whatever wrote them: frames with poses, cameras and masks."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from data_prep.posed.lens import Lens
from sceneprior.errors import InputError

INSTANCES = "instances"
_PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".exr", ".tif", ".tiff", ".bmp", ".heic")
_OPENCV = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")

Number = Annotated[float, Field(gt=-1e12, lt=1e12)]


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
    def _has_a_lens_that_is_read(self) -> "Camera":
        model = str(self.camera_model)[:40]
        if model.upper() not in (*_OPENCV, *_FISHEYE):
            raise ValueError(
                f"its camera_model is {model}; expected a pinhole, OPENCV or OPENCV_FISHEYE. "
                "Undistort pictures and masks, or model the camera again."
            )
        stray = {"p1": self.p1, "p2": self.p2} if self.fisheye else {"k4": self.k4}
        for key, value in stray.items():
            if value:
                kind = "OPENCV_FISHEYE" if self.fisheye else "OPENCV"
                raise ValueError(f"its {key} is {value:g}, which {kind} does not have.")
        return self

    @property
    def fisheye(self) -> bool:
        """Whether OpenCV's fisheye model bends its rays."""
        return bool(self.is_fisheye) or str(self.camera_model).upper() in _FISHEYE

    @property
    def lens(self) -> Lens:
        """The distortion."""
        if self.fisheye:
            return Lens((self.k1, self.k2, self.k3, self.k4), fisheye=True)
        return Lens((self.k1, self.k2, self.p1, self.p2, self.k3))


@dataclass(frozen=True)
class PosedFrame:
    """One frame of a room."""

    name: str
    """Its `file_path`, for messages."""
    camera_to_world: np.ndarray
    """(4, 4) float64 as written: OpenGL axes (x right, y up, z backward), the file's units."""
    instances: Path
    """PNG of tracked ids; it may be missing."""
    known: Path | None
    """PNG that is 0 where nothing is known, from `mask_path`."""
    camera: Camera


@dataclass(frozen=True)
class Recording:
    """What the files of a room say."""

    folder: Path
    path: Path
    """The file that has the poses, for messages."""
    frames: tuple[PosedFrame, ...]
    floor_m: float | None
    """Height of the floor along the up axis, metres."""
    floor_center_m: tuple[float, float] | None
    """Of the floor, along the two level axes in their order, metres."""
    metres_per_unit: float | None
    leveled: bool = True
    """Whether an axis of the poses' world points up; COLMAP's worlds lie as they come."""


def ids_path(folder: Path, name: str) -> Path:
    """The PNG of ids of a frame, by its `file_path`: `instances/<the same path>.png` if it is
    there, for frames of several folders, else `instances/<stem>.png`."""
    path = Path(name)
    path = path.with_suffix("") if path.suffix.lower() in _PICTURES else path
    whole = folder / INSTANCES / f"{path}.png"
    if ".." not in path.parts and not path.is_absolute() and whole.is_file():
        return whole
    return folder / INSTANCES / f"{path.name}.png"


def check_one_png_a_frame(path: Path, frames: tuple[PosedFrame, ...]) -> None:
    """Refuse frames that would share a PNG of ids, as an `InputError`."""
    first: dict[Path, str] = {}
    for frame in frames:
        other = first.setdefault(frame.instances, frame.name)
        if other is not frame.name:
            raise InputError(
                f"{path}: frames '{other}' and '{frame.name}' would share the ids in "
                f"{frame.instances}; put them where the frames lie, in {INSTANCES}/{_plain(other)}."
            )


def _plain(name: str) -> str:
    path = Path(name)
    return f"{path.with_suffix('') if path.suffix.lower() in _PICTURES else path}.png"


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


_M = TypeVar("_M", bound=BaseModel)


def checked(model: type[_M], data: dict[str, Any], where: str) -> _M:
    """Plain data as the model it should be; an `InputError` names the key."""
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

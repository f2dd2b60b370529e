"""A posed room, independent of its file format: frames with poses, cameras and masks."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from data_prep.readers.frames import is_pose
from data_prep.readers.posed.lens import Lens
from sceneprior.core.cameras import odd_field_of_view
from sceneprior.core.checked import plain, shown
from sceneprior.core.errors import InputError

INSTANCES = "instances"
_PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".exr", ".tif", ".tiff", ".bmp", ".heic")
_LONGEST_NAME = 240
"""Maximum bytes of a path component; file systems take 255, and suffixes are replaced."""
_OPENCV = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")

Number = Annotated[float, Field(gt=-1e12, lt=1e12)]


class Camera(BaseModel):
    """Camera keys of a frame, or of a file for all its frames."""

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
        model = plain(str(self.camera_model)) if isinstance(self.camera_model, str) else "no text"
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
        """True for OpenCV's fisheye model."""
        return bool(self.is_fisheye) or str(self.camera_model).upper() in _FISHEYE

    @property
    def lens(self) -> Lens:
        """Lens distortion."""
        if self.fisheye:
            return Lens((self.k1, self.k2, self.k3, self.k4), fisheye=True)
        return Lens((self.k1, self.k2, self.p1, self.p2, self.k3))


class PosedPicture(NamedTuple):
    """A picture as a tool's files describe it."""

    name: str
    camera_to_world: np.ndarray
    """(4, 4) float64 as written: OpenGL axes (x right, y up, z backward), in the file's units."""
    camera: Camera


@dataclass(frozen=True)
class PosedFrame:
    """One frame of a room: a `PosedPicture`, and the files of its ids."""

    name: str
    """Value of `file_path`, for messages."""
    camera_to_world: np.ndarray
    camera: Camera
    instances: Path
    """PNG of ids, if masks are PNGs; it may be missing."""
    known: Path | None = None
    """PNG from `mask_path`; 0 marks pixels with unknown ids."""

    @property
    def stem(self) -> str:
        """File name without folders and extension, under which segmenters store the masks."""
        return Path(_as_png(self.name)).stem


@dataclass(frozen=True)
class Recording:
    """Contents of a room's files."""

    folder: Path
    path: Path
    """File with the poses, for messages."""
    frames: tuple[PosedFrame, ...]
    floor_m: float | None
    """Height of the floor along the up axis, metres."""
    floor_center_m: tuple[float, float] | None
    """Centre of the floor along the two horizontal axes in their order, metres."""
    metres_per_unit: float | None
    up: str = "z"
    """Axis of the poses' world that points up; `cameras` if no axis does, as in COLMAP's worlds."""

    def good_poses(self) -> np.ndarray:
        """The poses that are valid, (n, 4, 4), as written."""
        poses = np.stack([frame.camera_to_world for frame in self.frames])
        return poses[is_pose(poses)]


def path_text(name: str) -> str:
    """Check that a file can have this name, and return it unchanged."""
    try:
        longest = max(map(len, name.encode().split(b"/")))
    except UnicodeEncodeError:
        longest = 0
    if not 0 < longest <= _LONGEST_NAME or "\0" in name:
        raise InputError(f"{shown(name)} is not a valid file name.")
    return name


def ids_path(folder: Path, name: str) -> Path:
    """Path of a frame's instance-id PNG; `name` is the frame's `file_path`.

    The path is `instances/<name without its extension>.png` if that exists (for frames in several
    folders), else `instances/<stem>.png`.
    """
    path = Path(_as_png(path_text(name)))
    whole = folder / INSTANCES / path
    if ".." not in path.parts and not path.is_absolute() and whole.is_file():
        return whole
    return folder / INSTANCES / path.name


def _as_png(name: str) -> str:
    path = Path(name)
    return f"{path.with_suffix('') if path.suffix.lower() in _PICTURES else path}.png"


def check_one_png_a_frame(path: Path, frames: tuple[PosedFrame, ...]) -> None:
    """Raise an `InputError` if two frames would share an instance-id PNG."""
    first: dict[Path, str] = {}
    for frame in frames:
        other = first.setdefault(frame.instances, frame.name)
        if other is not frame.name:
            raise InputError(
                f"{path}: frames {shown(other)} and {shown(frame.name)} would share the ids in "
                f"{frame.instances}; store the ids in the same folders as the frames: "
                f"{INSTANCES}/{_as_png(other)}."
            )


def room_name(folder: Path) -> str:
    """Name of a room: the name of its folder, even if that was given as `.`."""
    name = Path(folder).name
    return name if name not in ("", "..") else Path(folder).resolve().name


def frame_intrinsics(
    frame: PosedFrame | PosedPicture, mask_size: tuple[int, int]
) -> tuple[np.ndarray, tuple[int, int]]:
    """Pinhole intrinsics of a frame, and the (height, width) of the picture that they refer to.

    `w`, `h` default to the mask's size, `mask_size` (height, width); `cx`, `cy` to the image
    centre; `fl_x` to the value from `camera_angle_x`; `fl_y` to the one from `camera_angle_y`, or
    to `fl_x`. Pixel centres are at i + 0.5, as in nerfstudio, COLMAP and this package.
    """
    camera = frame.camera
    where = f"frame {shown(frame.name)}"
    width = mask_size[1] if camera.w is None else camera.w
    height = mask_size[0] if camera.h is None else camera.h
    if width < 1 or height < 1 or width % 1 or height % 1:
        raise InputError(f"{where}: w, h are {width}, {height}; expected pixel counts")
    fl_x = camera.fl_x or _focal(frame, "camera_angle_x", width)
    if fl_x is None:
        raise InputError(f"{where} has no fl_x and no camera_angle_x, here or for the whole file")
    fl_y = camera.fl_y or _focal(frame, "camera_angle_y", height) or fl_x
    if fl_x <= 0 or fl_y <= 0:
        raise InputError(f"{where}: fl_x, fl_y are {fl_x}, {fl_y}; expected above 0")
    for key, focal in (("fl_x", fl_x), ("fl_y", fl_y)):
        if odd := odd_field_of_view(focal, (int(height), int(width))):
            raise InputError(f"{where}, {key}: {odd}")
    cx = width / 2 if camera.cx is None else camera.cx
    cy = height / 2 if camera.cy is None else camera.cy
    return np.array([[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1.0]]), (int(height), int(width))


def _focal(frame: PosedFrame | PosedPicture, key: str, side: float) -> float | None:
    """Focal length in pixels from `camera_angle_x` or `_y`; None if the key is missing."""
    angle_rad: float | None = getattr(frame.camera, key)
    if not angle_rad:
        return None
    if not 0 < angle_rad < math.pi:
        guess = f"degrees? Give radians: {math.radians(angle_rad):.3g}"
        raise InputError(
            f"frame {shown(frame.name)}: {key} is {angle_rad:g}, expected radians between 0 and pi"
            + (f"; {guess}" if 0 < angle_rad < 180 else "")
        )
    return side / 2 / math.tan(angle_rad / 2)

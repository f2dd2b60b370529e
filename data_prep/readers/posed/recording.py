"""A posed room, independent of its file format: frames with their files, and its up direction."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data_prep.readers.frames import GL_TO_CV, is_pose
from data_prep.readers.posed.cameras import Camera
from sceneprior.core.cameras import odd_field_of_view, rigid
from sceneprior.core.checked import shown
from sceneprior.core.errors import InputError

INSTANCES = "instances"
_PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".exr", ".tif", ".tiff", ".bmp", ".heic")
_LONGEST_NAME = 240
"""Maximum bytes of a path component; file systems take 255, and suffixes are replaced."""
UP = ("auto", "z", "y", "cameras")
_Y_UP = {
    "y": np.eye(4),
    # (x, y, z) with z up -> (x, z, -y); stays right-handed.
    "z": np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
}
_LARGEST_SPREAD_M = 100.0
_LEAST_TURN = 0.1
"""Minimum ratio of the second to the first singular value of the cameras' sideways axes; if all
cameras look the same way, their tilt cannot be determined."""


class PosedFrame(NamedTuple):
    """One frame of a room."""

    name: str
    """Value of `file_path`, for messages."""
    camera_to_world: np.ndarray
    """(4, 4) float64 as written: OpenGL axes (x right, y up, z backward), in the file's units."""
    camera: Camera
    instances: Path = Path()
    """PNG of ids, if masks are PNGs; it may be missing."""
    known: Path | None = None
    """PNG from `mask_path`; 0 marks pixels with unknown ids."""

    @property
    def stem(self) -> str:
        """File name without folders and extension, under which segmenters store the masks."""
        return Path(as_png(self.name)).stem


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
    notes: tuple[str, ...] = ()
    """Sentences on what was not read."""
    up: str = "z"
    """Axis of the poses' world that points up; `cameras` if no axis does, as in COLMAP's worlds."""

    def good_poses(self) -> np.ndarray:
        """The poses that are valid, (n, 4, 4), as written."""
        poses = np.stack([frame.camera_to_world for frame in self.frames])
        return poses[is_pose(poses)]


def path_text(name: str) -> str:
    """Check that a file can have this name, and return it with slashes for backslashes."""
    name = name.replace("\\", "/")
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
    path = Path(as_png(path_text(name)))
    whole = folder / INSTANCES / path
    if ".." not in path.parts and not path.is_absolute() and whole.is_file():
        return whole
    return folder / INSTANCES / path.name


def as_png(name: str) -> str:
    """Name of a frame's PNG; programs on Windows write backslashes into names."""
    path = Path(name.replace("\\", "/"))
    return f"{path.with_suffix('') if path.suffix.lower() in _PICTURES else path}.png"


def room_name(folder: Path) -> str:
    """Name of a room: the name of its folder, even if that was given as `.`."""
    name = Path(folder).name
    return name if name not in ("", "..") else Path(folder).resolve().name


def frame_intrinsics(
    frame: PosedFrame, mask_size: tuple[int, int]
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


def _focal(frame: PosedFrame, key: str, side: float) -> float | None:
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


def upright_cameras(
    recording: Recording, frames: Sequence[int], up: str, metres_per_unit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rotate cameras to a world whose y points up, in metres.

    `up` is one of `UP`; `auto` is the recording's own.

    Returns:
        Camera-to-world matrices, (views, 4, 4) with OpenCV axes, and the (4, 4) transform from the
        file's world (in metres) to this one.
    """
    poses = np.stack([recording.frames[i].camera_to_world for i in frames])
    poses[:, :3, 3] *= recording.metres_per_unit or metres_per_unit
    if up == "auto":
        up = recording.up
    turn = _turn_of_cameras(recording, poses) if up == "cameras" else _Y_UP[up]
    upright = turn @ poses
    spread = np.ptp(upright[:, :3, 3], axis=0).max()
    if spread > _LARGEST_SPREAD_M:
        unit = "0.01, if they are in centimetres" if spread < 3000 else "0.001, in millimetres"
        raise InputError(
            f"{recording.path}: its cameras are spread over {spread:.0f} m; is metres_per_unit "
            f"wrong? Pass --metres-per-unit {unit}."
        )
    return upright @ GL_TO_CV, turn


def _turn_of_cameras(recording: Recording, poses: np.ndarray) -> np.ndarray:
    """Rotation (4, 4) that makes y the up direction of cameras that were held upright.

    The sideways axes of such cameras are horizontal, whatever their pitch, so up is the direction
    perpendicular to all of them.
    """
    _, strength, axes = np.linalg.svd(poses[:, :3, 0])
    if len(strength) < 2 or strength[1] < _LEAST_TURN * strength[0]:
        raise InputError(
            f"{recording.path}: its cameras all look in about the same direction, so the up "
            "direction is unknown; turn the poses until an axis points up, and name it with --up."
        )
    y = axes[2] * np.sign(axes[2] @ poses[:, :3, 1].sum(axis=0))
    x = np.eye(3)[np.argmin(np.abs(y))]
    x = x - (x @ y) * y
    x /= np.linalg.norm(x)
    return rigid((x, y, np.cross(x, y)))


def floor_center(recording: Recording, turn: np.ndarray) -> np.ndarray | None:
    """x, z of the floor's centre in the world of `upright_cameras`; None if the file has none."""
    if recording.floor_center_m is None:
        return None
    level = [axis for axis in range(3) if abs(turn[1, axis]) < 0.5]
    if len(level) != 2 or not np.isin(np.abs(turn[1]), (0.0, 1.0)).all():
        raise InputError(
            f"{recording.path}: floor_center_m is along two level axes, but none of this world's "
            "is level; leave it out, or turn the poses and name the axis with --up."
        )
    center = np.zeros(4)
    center[level] = recording.floor_center_m
    return (turn @ center)[[0, 2]]


def why_below_floor(recording: Recording, turn: np.ndarray) -> str:
    """Likely reason why cameras are below the floor, as the end of a sentence."""
    written = recording.good_poses()
    axis = int(np.abs(turn[1, :3]).argmax())
    # The sideways axis of an upright camera is level: it has no part along the axis up.
    level, level_if_inverted = np.abs(written[:, axis, 0]), np.abs(written[:, 0, axis])
    if level_if_inverted.mean() < 0.5 * level.mean():
        return "the matrices seem to be world-to-camera: invert each."
    other = seems_up(recording)
    if level.mean() > 0.2 and other is not None and "xyz"[axis] != other:
        return f"the tops of the pictures point along {other}: pass --up {other}."
    return (
        "are the last columns of the matrices translations from world to camera, not positions "
        "(-R t)? Else check floor_m, metres_per_unit and --up."
    )


def seems_up(recording: Recording) -> str | None:
    """Axis along which the cameras' up vectors point, `y` or `z`; None if neither is clear."""
    tops = recording.good_poses()[:, :3, 1]
    if not len(tops):
        return None
    mean = tops.mean(axis=0)
    best = "y" if mean[1] > mean[2] else "z"
    return best if max(mean[1], mean[2]) > 0.7 else None

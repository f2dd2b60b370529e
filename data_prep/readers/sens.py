"""Reads the cameras of a scan of ScanNet: its recording (`.sens`) and its alignment (`.txt`)."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from data_prep.readers.frames import is_pose, pose_fault
from data_prep.readers.scanned_mesh import unreadable
from sceneprior.core.errors import InputError

VERSION = 4
_COLOR_KINDS, _DEPTH_KINDS = (-1, 0, 1, 2), (-1, 0, 1, 2)
_LONGEST_SIDE_PX = 1 << 16
"""Image size from which a file counts as damaged; the data set has no such images."""
_FRAME = struct.Struct("<16f4Q")
"""Header of a frame: camera_to_world; timestamps and byte counts of colour and depth."""
_AFTER_CALIBRATION = struct.Struct("<2i4IfQ")
"""Rest of the header: compressions; widths and heights of colour and depth; depth shift; number of
frames."""


@dataclass(frozen=True)
class SensRecording:
    """Cameras of a `.sens` recording.

    Depth and colour of the release are already aligned, so the header's extrinsics are not used.
    """

    intrinsics: np.ndarray
    """(3, 3) float64, of the colour camera in pixels of a frame of `color_size`."""
    color_size: tuple[int, int]
    """(height, width) of the colour frames."""
    camera_to_world: np.ndarray
    """(frames, 4, 4) float32, OpenCV axes, metres, as written: untracked frames hold infinities."""


def read_sens(path: Path) -> SensRecording:
    """Read the header and the pose of every frame; errors name the file, the frame and the byte.

    Only the 96 bytes before each frame's pictures are read, so that a recording of several GB needs
    about a hundred bytes of memory per frame.

    Source: ScanNet's SensReader (sensorData.h), version 4.
    """
    try:
        # The file is unbuffered, because a buffer would read 100 KB around every header.
        file = path.open("rb", buffering=0)
    except OSError as error:
        raise InputError(
            f"{path} cannot be opened ({error.strerror}); "
            "a scan folder holds its recording as <scene>.sens."
        ) from None
    with file:
        return _Reader(path, file, path.stat().st_size).recording()


@dataclass(frozen=True)
class _Reader:
    path: Path
    file: BinaryIO
    size: int

    def recording(self) -> SensRecording:
        version = int.from_bytes(self._read(0, 4, "header", "the version"), "little")
        if version != VERSION:
            raise InputError(
                f"{self._where('header', 0)}: version {version}, expected {VERSION}; "
                "this is not a .sens file of ScanNet's release, or it is damaged."
            )
        length = int.from_bytes(self._read(4, 8, "header", "the sensor's name"), "little")
        self._check_end("header", 12, length, "the sensor's name")
        at = 12 + length
        matrices = self._read(at, 4 * 64, "header", "the calibration")
        intrinsics = np.eye(3)
        intrinsics[:2] = np.frombuffer(matrices, dtype="<f4", count=16).reshape(4, 4)[:2, :3]
        focal = intrinsics[(0, 1), (0, 1)]
        if not np.isfinite(intrinsics[:2]).all() or not (focal > 0).all():
            raise InputError(
                f"{self._where('header', at)}: the colour camera's focal lengths are "
                f"{focal[0]:g} and {focal[1]:g} pixels; the file is damaged. Download it again."
            )
        # ScanNet puts pixel centres at integers: its tools unproject pixel x, y by K^-1 (x, y, 1).
        intrinsics[:2, 2] += 0.5
        at += len(matrices)
        rest = self._read(at, _AFTER_CALIBRATION.size, "header", "the sizes")
        color_kind, depth_kind, width, height, *depth, _, frames = _AFTER_CALIBRATION.unpack(rest)
        where = self._where("header", at)
        if color_kind not in _COLOR_KINDS or depth_kind not in _DEPTH_KINDS:
            raise InputError(
                f"{where}: compressions {color_kind} (colour) and {depth_kind} (depth), "
                "expected 0, 1 or 2; the file is damaged. Download it again."
            )
        if min(width, height) < 1 or max(width, height, *depth) >= _LONGEST_SIDE_PX:
            raise InputError(
                f"{where}: colour pictures of {width} x {height} and depth of {depth[0]} x "
                f"{depth[1]} are implausible; the file is damaged. Download it again."
            )
        if not frames:
            raise InputError(f"{where}: the recording has no frames. Download it again.")
        return SensRecording(intrinsics, (height, width), self._poses(at + len(rest), frames))

    def _poses(self, at: int, frames: int) -> np.ndarray:
        poses = bytearray()  # grows as frames are read: a damaged count must not allocate memory
        for frame in range(frames):
            name = f"frame {frame}"
            head = self._read(at, _FRAME.size, name, "its pose and sizes")
            *_, color, depth = _FRAME.unpack(head)
            poses += head[:64]
            at += _FRAME.size
            self._check_end(name, at, color, "the colour picture")
            self._check_end(name, at + color, depth, "the depth picture")
            at += color + depth
        # The count of IMU records comes next. A file may end here without loss to us, but a
        # truncated number means a broken download.
        if at != self.size:
            self._check_end("IMU records", at, 8, "their count")
        return np.frombuffer(poses, "<f4").reshape(-1, 4, 4).astype(np.float32)

    def _read(self, start: int, size: int, frame: str, what: str) -> bytes:
        self._check_end(frame, start, size, what)
        try:
            self.file.seek(start)
            return self.file.read(size)
        except OSError as error:
            raise InputError(
                f"{self._where(frame, start)}: {what} cannot be read ({error.strerror})."
            ) from None

    def _check_end(self, frame: str, start: int, size: int, what: str) -> None:
        """Check that bytes `start` to `start + size` lie inside the file."""
        left = max(self.size - start, 0)
        if size > left:
            # A negative size, read as unsigned, is very large and also ends here.
            raise InputError(
                f"{self._where(frame, start)}: {what} should take {size} bytes, but {left} are "
                "left; the file is truncated or damaged. Download it again."
            )

    def _where(self, frame: str, byte: int) -> str:
        return f"{self.path}, {frame}, byte {byte}"


def read_properties(path: Path) -> dict[str, str]:
    """Read the `key = value` lines of `<scan>.txt`."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise unreadable(path, error) from None
    pairs = (line.partition("=") for line in lines)
    return {key.strip(): value.strip() for key, equals, value in pairs if equals}


def axis_alignment(path: Path, properties: dict[str, str]) -> np.ndarray:
    """Rigid transform, (4, 4) float64, that aligns the scan's walls with the axes; z is up.

    The identity if the file has none, as for scans of version 1 and test scans.
    """
    if "axisAlignment" not in properties:
        return np.eye(4)
    words = properties["axisAlignment"].split()
    try:
        matrix = np.array([float(word) for word in words]).reshape(4, 4)
    except ValueError:
        raise InputError(
            f"{path}: axisAlignment is {len(words)} words, expected 16 numbers. "
            "Download the scan again."
        ) from None
    if not is_pose(matrix[None])[0]:
        raise InputError(
            f"{path}: axisAlignment is not a rotation with a translation: {pose_fault(matrix)}; "
            "the file is damaged, or an axis was flipped. Download the scan again."
        )
    return matrix

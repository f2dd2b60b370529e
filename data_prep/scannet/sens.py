"""Reads poses, intrinsics and single colour frames of a `.sens` recording; it stays on disk."""

import contextlib
import struct
from array import array
from pathlib import Path
from typing import BinaryIO

import numpy as np

from sceneprior.errors import InputError

VERSION = 4
COLOR_KINDS = {-1: "unknown", 0: "raw", 1: "png", 2: "jpeg"}
_DEPTH_KINDS = (-1, 0, 1, 2)
_LONGEST_SIDE_PX = 1 << 16
"""No camera of this data set is larger; such numbers are damage."""
_FRAME = struct.Struct("<16f4Q")
"""camera_to_world; times of colour and depth; bytes of colour and depth."""
_AFTER_CALIBRATION = struct.Struct("<2i4IfQ")
"""Compressions; colour and depth width, height; depth shift; frames."""


class SensFile:
    """One open `.sens`: the header and every frame's pose in memory, the pictures on disk.

    Opening reads the 96 bytes before each frame's payloads and seeks over the payloads, so that a
    recording of several GB costs about a hundred bytes of memory a frame. Close it, or use it in
    a `with` block.

    Attributes:
        intrinsic_color: (4, 4) float64, the colour camera's, pixels of a frame of `color_size`.
            ScanNet counts pixel centres in whole numbers (its own tools lift pixel x, y with
            K^-1 (x, y, 1)); `data_prep.frames.mask_intrinsics` turns them into ours.
        color_size: (height, width) of the colour frames.
        color_kind: unknown, raw, png or jpeg.
        camera_to_world: (frames, 4, 4) float32, OpenCV axes, metres, as written: lost frames
            hold infinities. Depth and colour of the release are aligned already; the
            extrinsics of the header are therefore not used.

    Raises:
        InputError: the file is missing, of another version, truncated, or has impossible sizes;
            the message names file, frame and byte.

    Source: ScanNet's SensReader (sensorData.h), version 4.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        try:
            # Unbuffered: a buffer would read 100 KB around every header it seeks to.
            self._file: BinaryIO = self.path.open("rb", buffering=0)  # type: ignore[assignment]
            self._bytes = self.path.stat().st_size
        except OSError as error:
            raise InputError(
                f"{self.path} cannot be opened ({error.strerror}); "
                "a scan folder holds its recording as <scene>.sens."
            ) from None
        with contextlib.ExitStack() as undo:
            undo.callback(self.close)
            frames = self._read_header()
            self._read_index(frames)
            undo.pop_all()  # all went well: it stays open

    def __enter__(self) -> "SensFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self.camera_to_world)

    def close(self) -> None:
        """Release the file."""
        self._file.close()

    def color(self, frame: int) -> np.ndarray:
        """One colour frame, (height, width, 3) uint8, RGB.

        Raises:
            InputError: the picture is damaged or of another size than the header says.
        """
        start, size = (int(value) for value in self._color_at[frame])
        data = self._read(start, size, f"frame {frame}", "the colour picture")
        where = self._where(f"frame {frame}", start)
        if self.color_kind == "raw":
            if size != 3 * self.color_size[0] * self.color_size[1]:
                raise InputError(
                    f"{where}: the raw colour picture has {size} bytes, expected 3 x "
                    f"{self.color_size[1]} x {self.color_size[0]}. Download the scan again."
                )
            return np.frombuffer(data, dtype=np.uint8).reshape(*self.color_size, 3).copy()
        import cv2

        try:
            picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
        except cv2.error:  # an empty payload
            picture = None
        if picture is None:
            raise InputError(
                f"{where}: the colour picture ({self.color_kind}, {size} bytes) cannot be "
                "decoded. Download the scan again."
            )
        if picture.shape[:2] != self.color_size:
            raise InputError(
                f"{where}: the colour picture is {picture.shape[1]} x {picture.shape[0]}, but "
                f"the header says {self.color_size[1]} x {self.color_size[0]}."
            )
        return np.ascontiguousarray(picture[:, :, ::-1])

    def _read_header(self) -> int:
        version = int.from_bytes(self._read(0, 4, "header", "the version"), "little")
        if version != VERSION:
            raise InputError(
                f"{self._where('header', 0)}: version {version}, expected {VERSION}; "
                "this is no .sens of ScanNet's release, or it is damaged."
            )
        length = int.from_bytes(self._read(4, 8, "header", "the sensor's name"), "little")
        self._read_end("header", 12, length, "the sensor's name")
        at = 12 + length
        matrices = self._read(at, 4 * 64, "header", "the calibration")
        self.intrinsic_color = (
            np.frombuffer(matrices, dtype="<f4", count=16).reshape(4, 4).astype(np.float64)
        )
        focal = self.intrinsic_color[(0, 1), (0, 1)]
        if not np.isfinite(self.intrinsic_color[:2]).all() or not (focal > 0).all():
            raise InputError(
                f"{self._where('header', at)}: the colour camera's focal lengths are "
                f"{focal[0]:g} and {focal[1]:g} pixels; the file is damaged. Download it again."
            )
        at += len(matrices)
        rest = self._read(at, _AFTER_CALIBRATION.size, "header", "the sizes")
        color_kind, depth_kind, width, height, *depth, _, frames = _AFTER_CALIBRATION.unpack(rest)
        where = self._where("header", at)
        if color_kind not in COLOR_KINDS or depth_kind not in _DEPTH_KINDS:
            raise InputError(
                f"{where}: compressions {color_kind} (colour) and {depth_kind} (depth), "
                "expected 0, 1 or 2; the file is damaged. Download it again."
            )
        if min(width, height) < 1 or max(width, height, *depth) >= _LONGEST_SIDE_PX:
            raise InputError(
                f"{where}: colour pictures of {width} x {height} and depth of {depth[0]} x "
                f"{depth[1]} cannot be; the file is damaged. Download it again."
            )
        self.color_size = (height, width)
        self.color_kind = COLOR_KINDS[color_kind]
        self._frames_at = at + len(rest)
        if not frames:
            raise InputError(f"{where}: the recording has no frames. Download it again.")
        return int(frames)

    def _read_index(self, frames: int) -> None:
        """Visit every frame's header; where a colour payload begins, and its bytes."""
        # They grow with what is found: a damaged count must not ask for memory.
        poses, places = bytearray(), array("q")
        at = self._frames_at
        for frame in range(frames):
            name = f"frame {frame}"
            head = self._read(at, _FRAME.size, name, "its pose and sizes")
            *_, color, depth = _FRAME.unpack(head)
            poses += head[:64]
            at += _FRAME.size
            self._read_end(name, at, color, "the colour picture")
            self._read_end(name, at + color, depth, "the depth picture")
            places.extend((at, color))
            at += color + depth
        self.camera_to_world = np.frombuffer(poses, "<f4").reshape(-1, 4, 4).astype(np.float32)
        self._color_at = np.array(places).reshape(-1, 2)
        # The count of IMU records comes next. A file that ends right here lacks nothing we use;
        # half a number tells of a broken download.
        if at != self._bytes:
            self._read_end("IMU records", at, 8, "their count")

    def _read(self, start: int, size: int, frame: str, what: str) -> bytes:
        self._read_end(frame, start, size, what)
        try:
            self._file.seek(start)
            data = self._file.read(size)
        except OSError as error:
            raise InputError(
                f"{self._where(frame, start)}: {what} cannot be read ({error.strerror})."
            ) from None
        if len(data) != size:  # it was cut while it was open
            raise self._ends(frame, start, size, len(data), what)
        return data

    def _read_end(self, frame: str, start: int, size: int, what: str) -> None:
        """Check that bytes `start` to `start + size` lie inside the file."""
        if start + size > self._bytes:
            raise self._ends(frame, start, size, max(self._bytes - start, 0), what)

    def _ends(self, frame: str, start: int, size: int, left: int, what: str) -> InputError:
        # A negative size, read as unsigned, is just a very large one.
        return InputError(
            f"{self._where(frame, start)}: {what} should take {size} bytes, but {left} are left; "
            "the file is truncated or damaged. Download it again."
        )

    def _where(self, frame: str, byte: int) -> str:
        return f"{self.path}, {frame}, byte {byte}"

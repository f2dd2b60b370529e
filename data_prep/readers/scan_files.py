"""Reads the files of a scan of ScanNet: recording (`.sens`), alignment (`.txt`), masks (zip)."""

import io
import re
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image

from data_prep.readers.frames import is_pose, pose_fault
from data_prep.readers.scanned_mesh import unreadable
from sceneprior.core.checked import plain, shown
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import png_kind

MASK_FILES = {"filt": "_2d-instance-filt.zip", "raw": "_2d-instance.zip"}
"""Suffix of the archive's name, after the scan's, for each value of `--masks`."""
_LARGEST_MEMBER_BYTES = 64 << 20
"""Size limit of a mask; a mask of 1296 x 968 pixels has some 10 KB, or 1.2 MB uncompressed."""
VERSION = 4
_COMPRESSIONS = (-1, 0, 1, 2)
_LONGEST_SIDE_PX = 1 << 16
"""Image size from which a file counts as damaged; the data set has no such images."""
_ALIGNMENT = re.compile(r"\s*axisAlignment\s*=")
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
        with path.open("rb", buffering=0) as file:
            return _read(_Part(path, file, path.stat().st_size))
    except OSError as error:
        raise InputError(
            f"{path} cannot be opened ({error.strerror}); "
            "a scan folder holds its recording as <scene>.sens."
        ) from None


@dataclass
class _Part:
    """The part of a recording that is read: its place in the file, and its name for messages."""

    path: Path
    file: BinaryIO
    size: int
    at: int = 0
    name: str = "header"

    def take(self, count: int, what: str) -> bytes:
        """Read the next bytes."""
        self.check(count, what)
        data = self.file.read(count)
        self.at += count
        return data

    def skip(self, count: int, what: str) -> None:
        self.check(count, what)
        self.at = self.file.seek(self.at + count)

    def check(self, count: int, what: str) -> None:
        """Check that the next bytes lie inside the file."""
        if count > self.size - self.at:
            # A negative size, read as unsigned, is very large and also ends here.
            raise InputError(
                f"{self.where()}: {what} should take {count} bytes, but {self.size - self.at} are "
                "left; the file is truncated or damaged. Download it again."
            )

    def where(self) -> str:
        return f"{self.path}, {self.name}, byte {self.at}"


def _read(part: _Part) -> SensRecording:
    where = part.where()
    version = int.from_bytes(part.take(4, "the version"), "little")
    if version != VERSION:
        raise InputError(
            f"{where}: version {version}, expected {VERSION}; "
            "this is not a .sens file of ScanNet's release, or it is damaged."
        )
    part.skip(int.from_bytes(part.take(8, "the sensor's name"), "little"), "the sensor's name")
    where = part.where()
    intrinsics = np.eye(3)
    matrices = part.take(4 * 64, "the calibration")
    intrinsics[:2] = np.frombuffer(matrices, dtype="<f4", count=16).reshape(4, 4)[:2, :3]
    focal = intrinsics[(0, 1), (0, 1)]
    if not np.isfinite(intrinsics[:2]).all() or not (focal > 0).all():
        raise InputError(
            f"{where}: the colour camera's focal lengths are {focal[0]:g} and {focal[1]:g} pixels; "
            "the file is damaged. Download it again."
        )
    # ScanNet puts pixel centres at integers: its tools unproject pixel x, y by K^-1 (x, y, 1).
    intrinsics[:2, 2] += 0.5
    where = part.where()
    rest = part.take(_AFTER_CALIBRATION.size, "the sizes")
    color_kind, depth_kind, width, height, *depth, _, frames = _AFTER_CALIBRATION.unpack(rest)
    if color_kind not in _COMPRESSIONS or depth_kind not in _COMPRESSIONS:
        raise InputError(
            f"{where}: compressions {color_kind} (colour) and {depth_kind} (depth), expected 0, 1 "
            "or 2; the file is damaged. Download it again."
        )
    if min(width, height) < 1 or max(width, height, *depth) >= _LONGEST_SIDE_PX:
        raise InputError(
            f"{where}: colour pictures of {width} x {height} and depth of {depth[0]} x {depth[1]} "
            "are implausible; the file is damaged. Download it again."
        )
    if not frames:
        raise InputError(f"{where}: the recording has no frames. Download it again.")
    poses = bytearray()  # grows as frames are read: a damaged count must not allocate memory
    for frame in range(frames):
        part.name = f"frame {frame}"
        head = part.take(_FRAME.size, "its pose and sizes")
        poses += head[:64]
        *_, color_bytes, depth_bytes = _FRAME.unpack(head)
        part.skip(color_bytes, "the colour picture")
        part.skip(depth_bytes, "the depth picture")
    # The count of IMU records comes next. A file may end here without loss to us, but a truncated
    # number means a broken download.
    part.name = "IMU records"
    if part.at != part.size:
        part.check(8, "their count")
    camera_to_world = np.frombuffer(poses, "<f4").reshape(-1, 4, 4).astype(np.float32)
    return SensRecording(intrinsics, (height, width), camera_to_world)


def read_alignment(path: Path) -> np.ndarray | None:
    """Read the rigid transform, (4, 4), that aligns a scan's walls with the axes; z is up.

    It is among the `key = value` lines of `<scan>.txt`; None if the file has none, as for scans of
    version 1 and test scans.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise unreadable(path, error) from None
    values = [line.partition("=")[2].split() for line in lines if _ALIGNMENT.match(line)]
    if not values:
        return None
    words = values[-1]
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


class MaskArchive:
    """An open archive of masks: 8-bit grey PNGs, value = objectId + 1, 0 = no object.

    The stem of a member is its frame number (`instance-filt/123.png`), in any folder. `frames` are
    the numbers of the frames with a mask, ascending, and `image_size` is every mask's.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        try:
            self._zip = zipfile.ZipFile(self.path)
        except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError) as error:
            raise InputError(
                f"{self.path} cannot be opened as a zip ({error}); download it again."
            ) from None
        try:
            self._members = self._list()
            self.frames = tuple(sorted(self._members))
            width, height = self._open(self.frames[0]).size
            self.image_size = height, width
        except BaseException:
            self._zip.close()
            raise

    def close(self) -> None:
        self._zip.close()

    def read(self, frame: int) -> np.ndarray:
        """Read the mask of one frame, (height, width) uint8: objectId + 1, or 0 for no object."""
        picture = self._open(frame)
        width, height = picture.size
        if (height, width) != self.image_size:
            raise InputError(
                f"{self._where(frame)} is {width} x {height} pixels, but the masks before it "
                f"{self.image_size[1]} x {self.image_size[0]}; an archive has one size."
            )
        try:
            # Pillow rejects truncated pictures; cv2 would pad them.
            return np.asarray(picture).copy()
        except (OSError, ValueError, SyntaxError, EOFError, zlib.error) as error:
            raise self._damaged(frame, error) from None

    def _list(self) -> dict[int, zipfile.ZipInfo]:
        members: dict[int, zipfile.ZipInfo] = {}
        for item in self._zip.infolist():
            parts = item.filename.replace("\\", "/").split("/")
            if parts[0] == "" or ".." in parts or re.match(r"[A-Za-z]:", parts[0]):
                raise InputError(
                    f"{self.path} holds {shown(item.filename)}, a path outside of the archive, "
                    "which ScanNet's files never have. Do not use it: download the archive again."
                )
            found = re.fullmatch(r"([0-9]{1,9})\.png", parts[-1], re.IGNORECASE)
            if not found:
                continue  # folders, and files that macOS adds
            frame = int(found[1])
            if frame in members:
                raise InputError(
                    f"{self.path} holds frame {frame} twice: {shown(members[frame].filename)} and "
                    f"{shown(item.filename)}; keep one of them."
                )
            members[frame] = item
        if not members:
            raise InputError(
                f"{self.path} holds no masks; expected members such as instance-filt/0.png."
            )
        return members

    def _open(self, frame: int) -> Image.Image:
        data = self._bytes(frame)
        kind = png_kind(data)
        if kind is None:
            raise self._damaged(frame, "it is not a PNG")
        if kind != (8, "grey"):
            hint = "; 16-bit ones are the label archives (_2d-label)" if kind[0] == 16 else ""
            raise InputError(
                f"{self._where(frame)} has {kind[0]} bits, {kind[1]}; an instance mask has 8 bits, "
                f"grey{hint}."
            )
        try:
            picture = Image.open(io.BytesIO(data), formats=("PNG",))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            raise self._damaged(frame, "its header is damaged") from None
        if not 0 < picture.width * picture.height <= _LARGEST_MEMBER_BYTES:
            raise self._damaged(frame, f"{picture.width} x {picture.height} pixels")
        return picture

    def _bytes(self, frame: int) -> bytes:
        item = self._members[frame]
        if item.file_size > _LARGEST_MEMBER_BYTES:
            raise self._damaged(frame, f"{item.file_size} bytes unpacked")
        try:
            return self._zip.read(item)
        except (
            OSError, EOFError, ValueError, RuntimeError, zipfile.BadZipFile, zlib.error,
        ) as error:  # fmt: skip
            # RuntimeError means a password; NotImplementedError is a subclass.
            raise self._damaged(frame, error) from None

    def _damaged(self, frame: int, why: object) -> InputError:
        return InputError(
            f"{self._where(frame)} cannot be read ({plain(str(why), 200)}); download the archive "
            "again."
        )

    def _where(self, frame: int) -> str:
        return f"{self.path}, {plain(self._members[frame].filename)}"

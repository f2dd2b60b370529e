"""Reads single instance masks from a zip, without unpacking it to disk."""

import io
import re
import zipfile
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from sceneprior.core.errors import InputError
from sceneprior.core.instances.checked import plain, shown

MASK_FILES = {"filt": "_2d-instance-filt.zip", "raw": "_2d-instance.zip"}
"""Suffix of the archive's name, after the scan's, for each value of `--masks`."""
_LARGEST_MEMBER_BYTES = 64 << 20
"""Size limit of a mask; one of 1296 x 968 has some 10 KB, or 1.2 MB uncompressed."""
_PNG_START = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 26


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
            self.image_size = self._size(self.frames[0])
        except BaseException:
            self._zip.close()
            raise

    def __enter__(self) -> "MaskArchive":
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    def read(self, frame: int) -> np.ndarray:
        """Read the mask of one frame, (height, width) uint8: objectId + 1, or 0 for no object."""
        size = self._size(frame)
        if size != self.image_size:
            raise InputError(
                f"{self._where(frame)} is {size[1]} x {size[0]} pixels, but the masks before it "
                f"{self.image_size[1]} x {self.image_size[0]}; an archive has one size."
            )
        try:
            # Pillow rejects truncated pictures; cv2 would pad them.
            with Image.open(io.BytesIO(self._bytes(frame))) as picture:
                return np.asarray(picture).copy()
        except (OSError, ValueError, SyntaxError, EOFError, zlib.error) as error:
            raise self._damaged(frame, error) from None

    def _list(self) -> dict[int, zipfile.ZipInfo]:
        members: dict[int, zipfile.ZipInfo] = {}
        for item in self._zip.infolist():
            parts = item.filename.replace("\\", "/").split("/")
            if parts[0] == "" or ".." in parts or re.match(r"[A-Za-z]:", parts[0]):
                raise InputError(
                    f"{self.path} holds {shown(item.filename)}, a name that leads out of the "
                    "archive; no file of ScanNet's does. Do not use it: download the archive again."
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

    def _size(self, frame: int) -> tuple[int, int]:
        """Read the height and width of a mask from its PNG header."""
        head = self._bytes(frame, _HEADER_BYTES)
        if len(head) < _HEADER_BYTES or not head.startswith(_PNG_START):
            raise self._damaged(frame, "it is not a PNG")
        width, height = (int.from_bytes(head[i : i + 4], "big") for i in (16, 20))
        depth, kind = head[24:26]
        if (depth, kind) != (8, 0):
            colors = {0: "grey", 2: "RGB", 3: "palette", 4: "grey and alpha", 6: "RGBA"}
            hint = "; 16-bit ones are the label archives (_2d-label)" if depth == 16 else ""
            raise InputError(
                f"{self._where(frame)} has {depth} bits, {colors.get(kind, 'unknown colours')}; "
                f"an instance mask has 8 bits, grey{hint}."
            )
        if not 0 < width * height <= _LARGEST_MEMBER_BYTES:
            raise self._damaged(frame, f"{width} x {height} pixels")
        return height, width

    def _bytes(self, frame: int, count: int = -1) -> bytes:
        item = self._members[frame]
        if item.file_size > _LARGEST_MEMBER_BYTES:
            raise self._damaged(frame, f"{item.file_size} bytes unpacked")
        try:
            with self._zip.open(item) as file:
                return file.read(count)
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

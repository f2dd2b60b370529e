"""Reads single instance masks from a zip, without unpacking it to disk."""

import io
import re
import zipfile
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from sceneprior.core.checked import plain, shown
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import png_kind

MASK_FILES = {"filt": "_2d-instance-filt.zip", "raw": "_2d-instance.zip"}
"""Suffix of the archive's name, after the scan's, for each value of `--masks`."""
_LARGEST_MEMBER_BYTES = 64 << 20
"""Size limit of a mask; a mask of 1296 x 968 pixels has some 10 KB, or 1.2 MB uncompressed."""


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

    def __enter__(self) -> "MaskArchive":
        return self

    def __exit__(self, *_: object) -> None:
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

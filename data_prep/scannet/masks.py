"""Reads single instance masks out of a zip; nothing is unpacked to disk."""

import contextlib
import io
import re
import zipfile
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from sceneprior.errors import InputError

MASK_FILES = {"filt": "_2d-instance-filt.zip", "raw": "_2d-instance.zip"}
"""What `--masks` may be, and how the archive's name goes on after the scan's."""
_LARGEST_MEMBER_BYTES = 64 << 20
"""A mask of 1296 x 968 has some 10 KB, and 1.2 MB if it were not compressed at all."""
_PNG_START = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 26


class MaskArchive:
    """One open archive of masks: 8-bit grey PNGs, value = objectId + 1, 0 = nothing.

    A member's folder is free, its stem is the frame number (`instance-filt/123.png`). Close it,
    or use it in a `with` block.

    Attributes:
        frames: The frame numbers that have a mask, ascending.
        image_size: (height, width) of every mask.

    Raises:
        InputError: the file is missing, damaged or truncated; a member's name leaves the archive;
            two members are one frame; no member is a mask.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        try:
            self._zip = zipfile.ZipFile(self.path)
        except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError) as error:
            raise InputError(
                f"{self.path} cannot be opened as a zip ({error}); download it again."
            ) from None
        with contextlib.ExitStack() as undo:
            undo.callback(self.close)
            self._members = self._list()
            self.frames = tuple(sorted(self._members))
            self.image_size = self._size(self.frames[0])
            undo.pop_all()  # all went well: it stays open

    def __enter__(self) -> "MaskArchive":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the file."""
        self._zip.close()

    def read(self, frame: int) -> np.ndarray:
        """The mask of one frame, (height, width) uint8: objectId + 1, 0 where no object is.

        Raises:
            InputError: there is no such frame; the member is damaged, not 8-bit grey, or of
                another size than the archive's first.
        """
        if frame not in self._members:
            raise InputError(f"{self.path} has no mask of frame {frame}.")
        size = self._size(frame)
        if size != self.image_size:
            raise InputError(
                f"{self._where(frame)} is {size[1]} x {size[0]} pixels, but the masks before it "
                f"{self.image_size[1]} x {self.image_size[0]}; an archive has one size."
            )
        try:
            # Pillow rather than cv2: it refuses a picture that is cut off, cv2 fills it up.
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
                    f"{self.path} holds '{item.filename}', a name that leads out of the archive; "
                    "no file of ScanNet's does. Do not use it: download the archive again."
                )
            found = re.fullmatch(r"([0-9]{1,9})\.png", parts[-1], re.IGNORECASE)
            if not found:
                continue  # folders, and what a Mac adds
            frame = int(found[1])
            if frame in members:
                raise InputError(
                    f"{self.path} holds frame {frame} twice: '{members[frame].filename}' and "
                    f"'{item.filename}'; keep one of them."
                )
            members[frame] = item
        if not members:
            raise InputError(
                f"{self.path} holds no masks; expected members such as instance-filt/0.png."
            )
        return members

    def _size(self, frame: int) -> tuple[int, int]:
        """Height and width of a mask, from the first bytes of its PNG."""
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
            # RuntimeError: it has a password; NotImplementedError is one, too.
            raise self._damaged(frame, error) from None

    def _damaged(self, frame: int, why: object) -> InputError:
        return InputError(
            f"{self._where(frame)} cannot be read ({why}); download the archive again."
        )

    def _where(self, frame: int) -> str:
        return f"{self.path}, {self._members[frame].filename}"

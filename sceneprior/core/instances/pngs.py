"""Reads PNGs of tracked instance ids."""

import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from sceneprior.core.errors import InputError

_PNG_START = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 26
_COLORS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGBA"}


def png_kind(data: bytes) -> tuple[int, str] | None:
    """Bits per channel and colours of a PNG, from its first bytes; None if it is not a PNG."""
    if len(data) < _HEADER_BYTES or not data.startswith(_PNG_START):
        return None
    return data[24], _COLORS.get(data[25], "unknown colours")


def mask_size(path: Path, rgb: bool = False) -> tuple[int, int]:
    """Read the size of a mask, (height, width), without its pixels."""
    with _open(path, rgb) as picture:
        return picture.height, picture.width


def read_mask(path: Path) -> np.ndarray:
    """Read a mask of tracked ids, (height, width) uint16: one value per object, 0 for no object."""
    return _pixels(path, rgb=False).astype(np.uint16)


def read_rgb(path: Path) -> np.ndarray:
    """Read a mask with colour-coded ids, as in COCO's panoptic format: (height, width, 3) uint8."""
    return _pixels(path, rgb=True)


def _pixels(path: Path, rgb: bool) -> np.ndarray:
    try:
        with _open(path, rgb) as picture:
            return np.asarray(picture)
    except InputError:
        raise
    except (OSError, ValueError, SyntaxError, EOFError, MemoryError, zlib.error) as error:
        why = str(error)[:120] or "a part of it is said to be too large for memory"
        raise InputError(f"{path} is damaged ({why}).") from None


def _open(path: Path, rgb: bool) -> Image.Image:
    try:
        with path.open("rb") as file:
            kind = png_kind(file.read(_HEADER_BYTES))
        if kind is None:
            raise InputError(f"{path} is not a PNG; give ids as PNGs, which are lossless.")
        # The indices of a palette are the ids, as in DAVIS and the output of most segmenters.
        # Pillow rescales grey values of fewer than 8 bits, so those are rejected.
        wanted = "8-bit RGB, whose colours are segment ids"
        known = kind == (8, "RGB")
        if not rgb:
            wanted = "one channel of 8 or 16 bits, or a palette, whose values are instance ids"
            known = kind in ((8, "grey"), (16, "grey")) or kind[1] == "palette"
        if not known:
            raise InputError(f"{path} is {kind[0]}-bit {kind[1]}; expected {wanted}.")
        return Image.open(path, formats=("PNG",))
    except FileNotFoundError:
        raise InputError(f"{path} is missing.") from None
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} is not a readable PNG ({str(error)[:120]}).") from None

"""Reads PNGs of tracked instance ids."""

import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from sceneprior.core.errors import InputError

_PNG_START = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 26
_GREY, _RGB, _PALETTE = 0, 2, 3
_KINDS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGBA"}


def mask_size(path: Path, rgb: bool = False) -> tuple[int, int]:
    """Read the size of a mask, (height, width), without its pixels."""
    with _open(path, rgb) as picture:
        return picture.height, picture.width


def read_mask(path: Path) -> np.ndarray:
    """Read a mask of tracked ids, (height, width) uint16: one value per object, 0 for none."""
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
    except (OSError, ValueError, SyntaxError, EOFError, zlib.error) as error:
        raise InputError(f"{path} is damaged ({str(error)[:120]}).") from None


def _open(path: Path, rgb: bool) -> Image.Image:
    try:
        with path.open("rb") as file:
            head = file.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES or not head.startswith(_PNG_START):
            raise InputError(f"{path} is no PNG; ids are kept in PNGs, which lose nothing.")
        depth, kind = head[24:26]
        # The indices of a palette are the ids, as in DAVIS and the output of most segmenters.
        # Pillow rescales grey values of fewer than 8 bits, so those are rejected.
        if rgb and (kind, depth) != (_RGB, 8):
            raise InputError(
                f"{path} is {depth}-bit {_KINDS.get(kind, 'of unknown colours')}; expected 8-bit "
                "RGB, whose colours are segment ids."
            )
        if not rgb and kind != _PALETTE and (kind != _GREY or depth not in (8, 16)):
            raise InputError(
                f"{path} is {depth}-bit {_KINDS.get(kind, 'of unknown colours')}; expected one "
                "channel of 8 or 16 bits, or a palette, whose values are instance ids."
            )
        return Image.open(path, formats=("PNG",))
    except FileNotFoundError:
        raise InputError(f"{path} is missing.") from None
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} is no PNG that can be read ({str(error)[:120]}).") from None

"""Reads PNGs of tracked instance ids."""

import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from sceneprior.errors import InputError

_PNG_START = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 26
_GREY, _RGB, _PALETTE = 0, 2, 3
_KINDS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGBA"}


def mask_size(path: Path, rgb: bool = False) -> tuple[int, int]:
    """(height, width), without reading the pixels; see `read_mask` and `read_rgb`."""
    with _open(path, rgb) as picture:
        return picture.height, picture.width


def read_mask(path: Path) -> np.ndarray:
    """(height, width) uint16: the same value is the same object in all frames, 0 is nothing. A file
    that is missing, no PNG, of more than one channel or cut off is an `InputError`."""
    return _pixels(path, rgb=False).astype(np.uint16)


def read_rgb(path: Path) -> np.ndarray:
    """(height, width, 3) uint8: colours that stand for ids, as COCO's panoptic format has them. A
    file that is missing, no PNG of 8-bit RGB or cut off is an `InputError`."""
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
        # A palette's indices are the ids, as DAVIS and most segmenters write them. Pillow stretches
        # grey values of fewer than 8 bits, so those are refused.
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

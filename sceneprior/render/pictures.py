"""Composition of pictures: contact sheets, coloured instance ids, PNG and GIF bytes."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Integer, UInt8
from PIL import Image, ImageDraw, ImageFont

from sceneprior.core.classes import class_colors

CAPTION_PX = 18


def contact_sheet(
    tiles: Sequence[UInt8[np.ndarray, "_ _ 3"]],
    columns: int,
    captions: Sequence[str] = (),
    gap_px: int = 0,
) -> UInt8[np.ndarray, "height width 3"]:
    """Lay out pictures on a white sheet, row by row, with `columns` pictures in each row.

    All cells have the size of the largest tile; a smaller tile lies in the upper left corner of its
    cell. `captions` are written above the tiles, one for each. `gap_px` is the width of the white
    space around each tile.
    """
    height, width = (max(tile.shape[axis] for tile in tiles) for axis in (0, 1))
    above = gap_px + (CAPTION_PX if captions else 0)
    rows = -(-len(tiles) // columns)
    shape = (rows * (above + height) + gap_px, columns * (gap_px + width) + gap_px, 3)
    sheet = np.full(shape, 255, dtype=np.uint8)
    places = [
        (row * (above + height) + above, column * (gap_px + width) + gap_px)
        for row, column in (divmod(index, columns) for index in range(len(tiles)))
    ]
    for (top, left), tile in zip(places, tiles, strict=True):
        sheet[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    if not captions:
        return sheet
    picture, font = Image.fromarray(sheet), ImageFont.load_default(size=12)
    draw = ImageDraw.Draw(picture)
    for (top, left), caption in zip(places, captions, strict=True):
        draw.text((left, top - CAPTION_PX + 1), caption, fill="black", font=font)
    return np.array(picture)


def paint_ids(
    ids: Integer[np.ndarray, "height width"],
    colors: UInt8[np.ndarray, "objects 3"] | Integer[np.ndarray, "objects 3"],
    background: tuple[int, int, int],
) -> UInt8[np.ndarray, "height width 3"]:
    """Paint instance ids, with one colour per object and dark borders between objects.

    The ids of n objects are 0 = no object, k + 1 = object k, n + 1 = void, which is grey.
    """
    border = np.zeros(ids.shape, dtype=bool)
    border[:, 1:] |= ids[:, 1:] != ids[:, :-1]
    border[1:] |= ids[1:] != ids[:-1]
    palette = np.concatenate([[background], colors, class_colors(1)]).astype(np.uint8)
    # The dark colours follow the others in the table, so that one look-up per pixel suffices.
    shown = np.where(border, ids + np.intp(len(palette)), ids)
    return np.concatenate([palette, palette // 2]).take(shown, axis=0)


def png_bytes(picture: UInt8[np.ndarray, "height width 3"] | Image.Image, **options: Any) -> bytes:
    """Encode a picture as a PNG; `options` are passed to Pillow (`compress_level`, `optimize`)."""
    buffer = io.BytesIO()
    image = picture if isinstance(picture, Image.Image) else Image.fromarray(picture)
    image.save(buffer, format="PNG", **options)
    return buffer.getvalue()


def gif_bytes(
    pictures: Sequence[UInt8[np.ndarray, "height width 3"]], times: Sequence[int]
) -> bytes:
    """Encode pictures of one size as an endlessly looping GIF; `times` are durations in ms."""
    # One palette for all pictures; separate palettes would make flat areas flicker.
    palette = Image.fromarray(np.concatenate(pictures)).quantize(255, dither=Image.Dither.NONE)
    frames = [
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in pictures
    ]
    buffer = io.BytesIO()
    frames[0].save(
        buffer, format="GIF", save_all=True, append_images=frames[1:], duration=list(times), loop=0,
        optimize=False,
    )  # fmt: skip
    return buffer.getvalue()

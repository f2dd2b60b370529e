"""Appearance of a scene in pictures and files: colours, meshes and names of its objects; and the
composition of pictures: contact sheets, coloured instance ids, PNG and GIF bytes.

Metrics and pictures of masks use `classes.class_colors`, which differ as clearly as possible.
"""

import colorsys
import io
from collections.abc import Sequence
from typing import Any
from zlib import crc32

import numpy as np
from jaxtyping import Integer, UInt8
from PIL import Image, ImageDraw, ImageFont

from sceneprior.core.boxes import BOX_FACES, box_corners
from sceneprior.core.classes import class_colors
from sceneprior.core.files import file_name_of
from sceneprior.core.scene import Mesh, Scene, SceneObject

BACKGROUND = (255, 255, 255)
"""White, which differs clearly from all class colours and prints as paper."""

FLOOR_COLOR = (232, 228, 220)
WALL_COLOR = (252, 251, 249)
_COLORS = {
    # beds and sofas: cloth
    "double_bed": "7d93ad", "single_bed": "93aac0", "kids_bed": "a4b9b8", "bed": "8499b2",
    "sofa": "8d9d84", "armchair": "a9b598",
    # seats
    "chair": "b97c68", "dressing_chair": "c99787", "stool": "d9ab98", "toilet": "e6e9eb",
    # tables: light wood
    "table": "c6a477", "desk": "ba9160", "coffee_table": "a98358", "dressing_table": "dcc6a0",
    "counter": "b5ab9d", "bar": "9c7653",
    # storage: dark and painted wood
    "wardrobe": "b09378", "cabinet": "9f8268", "bookshelf": "bba187", "shelf": "c8b39c",
    "shelves": "c8b39c", "nightstand": "97704f", "night stand": "97704f", "dresser": "a8927f",
    "tv_stand": "8f8177", "children_cabinet": "d6c8b1",
    # lamps
    "pendant_lamp": "d9bd68", "ceiling_lamp": "e3cf93", "lamp": "dcc47d",
    # the rest
    "television": "565b63", "whiteboard": "d9dcdc", "bathtub": "c3d2d8", "sink": "a3bfcb",
    "refridgerator": "b9bec3", "void": "808080",
}  # fmt: skip


def quiet_colors(names: Sequence[str]) -> UInt8[np.ndarray, "classes 3"]:
    """One RGB colour for each class name, the same in every label set.

    A class without an entry in the table gets a muted colour that depends only on its name.
    """
    colors = []
    for name in names:
        mixed = crc32(name.encode())
        hue, lightness = mixed % 360 / 360, (0.52, 0.6, 0.68)[mixed // 360 % 3]
        muted = [round(255 * each) for each in colorsys.hls_to_rgb(hue, lightness, 0.24)]
        colors.append(bytes.fromhex(_COLORS[name]) if name in _COLORS else muted)
    return np.array([list(color) for color in colors], dtype=np.uint8).reshape(-1, 3)


def box_mesh(center_m: Sequence[float], size_m: Sequence[float]) -> Mesh:
    """A box as a mesh of 12 triangles that face outwards."""
    return Mesh(box_corners(np.asarray(center_m), np.asarray(size_m)), BOX_FACES)


def object_mesh(item: SceneObject) -> Mesh:
    """The object's mesh, or its box if it has none."""
    return item.mesh if item.mesh is not None else box_mesh(item.center_m, item.size_m)


def scene_meshes(scene: Scene) -> list[Mesh]:
    """One mesh per object, see `object_mesh`."""
    return [object_mesh(item) for item in scene.objects]


def object_colors(scene: Scene) -> UInt8[np.ndarray, "objects 3"]:
    """Muted RGB colour of each object's class, for pictures and files that people look at."""
    return quiet_colors([item.label for item in scene.objects])


def shell_color(node: str) -> UInt8[np.ndarray, "3"]:
    """The RGB colour of a node of a room's shell."""
    return np.array(FLOOR_COLOR if node == "floor" else WALL_COLOR, dtype=np.uint8)


def node_names(scene: Scene) -> list[str]:
    """Names of the objects in files, and of their files: `<index>_<class>`, as `file_name_of`."""
    return [file_name_of(f"{index}_{item.label}") for index, item in enumerate(scene.objects)]


def linear_rgba(color: UInt8[np.ndarray, "3"]) -> list[float]:
    """An sRGB colour as linear numbers in [0, 1], as glTF and USD have them, with opacity 1."""
    srgb = color / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return [*(float(value) for value in linear), 1.0]


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

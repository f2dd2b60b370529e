"""Appearance of a scene in pictures and files: colours, meshes and names of its objects.

Metrics and pictures of masks use `classes.class_colors`, which differ as clearly as possible.
"""

import colorsys
from collections.abc import Sequence
from zlib import crc32

import numpy as np
from jaxtyping import UInt8

from sceneprior.core.boxes import BOX_FACES, box_corners
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
    return np.array([_color(name) for name in names], dtype=np.uint8).reshape(-1, 3)


def _color(name: str) -> tuple[int, ...]:
    if name in _COLORS:
        return tuple(bytes.fromhex(_COLORS[name]))
    mixed = crc32(name.encode())
    hue, lightness = mixed % 360 / 360, (0.52, 0.6, 0.68)[mixed // 360 % 3]
    return tuple(round(255 * channel) for channel in colorsys.hls_to_rgb(hue, lightness, 0.24))


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
    """Names of the objects in files: `<index>_<class>`."""
    return [f"{index}_{item.label}" for index, item in enumerate(scene.objects)]


def linear_rgba(color: UInt8[np.ndarray, "3"]) -> list[float]:
    """An sRGB colour as linear numbers in [0, 1], as glTF and USD have them, with opacity 1."""
    srgb = color / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return [*(float(value) for value in linear), 1.0]

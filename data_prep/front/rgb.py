"""Pictures of a prepared room for people and for later work: its views, shaded, as PNG files.

The room's floor, walls and ceiling are a backdrop only: as in the instance ids, no wall hides a
piece, so that picture and masks of a view agree pixel by pixel.
"""

from collections.abc import Sequence

import numpy as np
import shapely

from data_prep.front.furnished import Room
from sceneprior.classes import class_colors, label_set
from sceneprior.offscreen import Pinhole, Renderer
from sceneprior.pictures import png_bytes
from sceneprior.scene import Mesh
from sceneprior.shards import RoomViews

FOLDER = "rgb"
_FLOOR, _WALL, _CEILING = (196, 178, 153), (226, 224, 218), (244, 244, 242)
_OUTSIDE = (255, 255, 255)


def rgb_files(
    room: Room,
    colors: Sequence[tuple[int, int, int] | None],
    views: RoomViews,
    label_set_name: str,
    renderer: Renderer,
) -> dict[str, bytes]:
    """`rgb/<room>/<view>.png` -> its bytes, for every view.

    Void furniture is drawn, too. `colors` has one of each piece; None: its class's. The renderer
    draws the same picture whatever its kind (`Renderer.shaded`).
    """
    names = label_set(label_set_name)
    of_class = class_colors(len(names))
    painted = np.array(
        [
            of_class[names.index(piece.label)] if color is None else color
            for piece, color in zip(room.furniture, colors, strict=True)
        ],
        dtype=np.uint8,
    )
    meshes = [piece.mesh for piece in room.furniture]
    shell = shell_of(room)
    shell_colors = np.array([_FLOOR, _WALL, _CEILING], dtype=np.uint8)
    files = {}
    for view, (turn, K) in enumerate(zip(views.world_to_camera, views.intrinsics, strict=True)):
        camera = Pinhole(turn.astype(np.float64), K.astype(np.float64))
        behind = renderer.shaded(shell, shell_colors, camera, views.image_size, _OUTSIDE)
        picture = renderer.shaded(meshes, painted, camera, views.image_size, behind)
        name = f"{FOLDER}/{room.room_id}/{view:04d}.png"
        files[name] = png_bytes(picture, compress_level=6)
    return files


def shell_of(room: Room) -> list[Mesh]:
    """Floor, walls and ceiling of a room as three meshes."""
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(room.floor))
    flat = np.array([np.asarray(triangle.exterior.coords)[:3] for triangle in triangles])
    parts = getattr(room.floor, "geoms", [room.floor])
    rings = [ring for part in parts for ring in (part.exterior, *part.interiors)]
    sides = np.concatenate([_sides(np.asarray(ring.coords)) for ring in rings])
    low, high = np.insert(sides, 1, 0.0, axis=2), np.insert(sides, 1, room.height_m, axis=2)
    walls = np.concatenate(
        [
            np.stack([low[:, 0], low[:, 1], high[:, 1]], 1),
            np.stack([low[:, 0], high[:, 1], high[:, 0]], 1),
        ]
    )
    floor, ceiling = (np.insert(flat, 1, height, axis=2) for height in (0.0, room.height_m))
    return [_soup(floor), _soup(walls), _soup(ceiling)]


def _sides(ring: np.ndarray) -> np.ndarray:
    """(n + 1, 2) closed outline -> (n, 2, 2) its sides."""
    return np.stack([ring[:-1], ring[1:]], axis=1)


def _soup(triangles: np.ndarray) -> Mesh:
    corners = triangles.reshape(-1, 3)
    return Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))

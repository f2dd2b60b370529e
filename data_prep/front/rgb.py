"""Shaded PNG pictures of a prepared room's views.

Floor, walls and ceiling are only a backdrop and occlude no furniture, as in the instance ids, so
that the picture and the masks of a view agree pixel by pixel.
"""

from collections.abc import Sequence

import numpy as np
import shapely

from data_prep.front.furnished import Room
from sceneprior.core.cameras import Pinhole
from sceneprior.core.classes import class_colors, label_set
from sceneprior.core.scene import Mesh
from sceneprior.core.shards import RoomViews
from sceneprior.render.offscreen import Renderer
from sceneprior.render.pictures import png_bytes

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
    """Render every view; returns the PNG bytes by path, `rgb/<room>/<view>.png`.

    Void furniture is also drawn. `colors` has one entry per piece; None means the colour of its
    class. All types of renderers draw the same picture (`Renderer.shaded`).
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
    return [soup(floor), soup(walls), soup(ceiling)]


def _sides(ring: np.ndarray) -> np.ndarray:
    """Split a closed outline (n + 1, 2) into its sides (n, 2, 2)."""
    return np.stack([ring[:-1], ring[1:]], axis=1)


def soup(triangles: np.ndarray) -> Mesh:
    """Mesh of triangles, (F, 3, 3), that share no corners."""
    corners = triangles.reshape(-1, 3)
    return Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))

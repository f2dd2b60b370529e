"""The viewer's scene nodes: a room, and the board with the map of the latent space."""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.apps.viewer.latent_map import LatentMap
from sceneprior.core.boxes import BOX_EDGES, box_corners
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.core.shell import ShellName, shell_meshes, shell_of
from sceneprior.render.appearance import object_colors, object_mesh, shell_color

if TYPE_CHECKING:
    import viser

LEAN_RAD = math.radians(40)
"""Tilt of the board, about the elevation of the page's initial camera."""
_BOX, _KEPT = (120, 120, 120), (230, 120, 20)
_BOARD, _DOT, _PATH, _HERE = (244, 243, 238), (70, 92, 140), (214, 110, 30), (200, 30, 60)
_SAME = 1e-4
"""Maximum difference of vertices, relative to the box, at which meshes count as equal."""
_EDGES = np.array(BOX_EDGES)
Point = tuple[float, float]
"""A point of the map."""


@dataclass
class Display:
    """Choices of what is shown with a room."""

    shell: ShellName
    """Parts of the room itself. If neither floor nor walls are shown, a grid is."""
    names: bool = False
    """Names and sizes of all objects."""
    boxes: bool = False
    models: bool = False
    """CAD models in place of the meshes of the prior or of the scene files."""
    nearest: bool = False
    """The training room with the nearest layout, beside the room."""


def name_and_size(item: SceneObject) -> str:
    """Text of an object's label: class name, and width, height and depth in metres.

    >>> name_and_size(SceneObject("double_bed", (0.0, 0.5, 0.0), (1.8, 1.0, 2.1)))
    'double bed 1.80 x 1.00 x 2.10 m'
    """
    return item.label.replace("_", " ") + " {:.2f} x {:.2f} x {:.2f} m".format(*item.size_m)


@dataclass
class _Node:
    handle: Any
    unit: np.ndarray
    """Vertices in the unit box."""
    faces: np.ndarray
    color: tuple[int, int, int]

    def is_alike(self, unit: np.ndarray, faces: np.ndarray, color: tuple[int, int, int]) -> bool:
        return (
            self.color == color
            and self.unit.shape == unit.shape
            and np.array_equal(self.faces, faces)
            and bool(np.abs(self.unit - unit).max(initial=0) < _SAME)
        )

    def remove(self) -> None:
        self.handle.remove()


class RoomNodes:
    """The nodes of one room, updated in place: only changes are sent to browsers.

    The nodes' names begin with `root`; `clicked` is called with the index of the clicked object.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        root: str,
        x_m: float,
        floor_m: float,
        clicked: Callable[[int], None] | None = None,
    ):
        self._scene, self._root, self._clicked = server.scene, root, clicked
        self._nodes: list[_Node] = []
        self._labels: list[Any] = []
        self._walls: list[Any] = []
        self._lines: list[Any] = []
        self.frame = self._scene.add_frame(root, show_axes=False, position=(x_m, 0.0, 0.0))
        self._grid = self._scene.add_grid(
            f"{root}/grid", floor_m, floor_m, plane="xz", position=(0.0, -0.005, 0.0),
            plane_color=(236, 233, 226), plane_opacity=1.0, cell_color=(222, 218, 208),
            section_color=(196, 190, 178),
        )  # fmt: skip

    def show(self, scene: Scene, display: Display, kept: Collection[int] = ()) -> None:
        """Show a scene in place of the previous one; objects that the user keeps get an orange box
        and a name."""
        walls = display.shell == "walls"
        self._show_shell(
            shell_of(scene).inner_meshes() if walls else shell_meshes(scene, display.shell)
        )
        colors = object_colors(scene).tolist()
        for row, (item, color) in enumerate(zip(scene.objects, colors, strict=True)):
            self._show_object(row, item, tuple(color))
        _keep(self._nodes, len(colors))
        rows = range(len(colors))
        self._show_labels([scene.objects[row] for row in rows if display.names or row in kept])
        self._show_boxes(scene, [row for row in rows if display.boxes or row in kept], kept)

    def _show_object(self, row: int, item: SceneObject, color: tuple[int, int, int]) -> None:
        center, size = np.array(item.center_m), np.maximum(item.size_m, 1e-6)
        mesh = object_mesh(item)
        unit = (np.asarray(mesh.vertices_m) - center) / size
        if row < len(self._nodes) and self._nodes[row].is_alike(unit, mesh.faces, color):
            handle = self._nodes[row].handle
            handle.position, handle.scale = center, tuple(size.tolist())
            return
        handle = self._scene.add_mesh_simple(
            f"{self._root}/object_{row}", unit, mesh.faces, color=color, flat_shading=True,
            side="double", position=center, scale=tuple(size.tolist()),
        )  # fmt: skip
        if (clicked := self._clicked) is not None:
            handle.on_click(lambda _: clicked(row))
        self._nodes[row : row + 1] = [_Node(handle, unit, mesh.faces, color)]

    def _show_shell(self, meshes: Mapping[str, Mesh]) -> None:
        self._grid.visible = not meshes
        _keep(self._walls, 0)
        self._walls += [
            self._scene.add_mesh_simple(
                f"{self._root}/{name}", mesh.vertices_m, mesh.faces,
                color=tuple(shell_color(name).tolist()),
                flat_shading=True, side="front", cast_shadow=False,
            )
            for name, mesh in meshes.items()
        ]  # fmt: skip

    def _show_labels(self, items: list[SceneObject]) -> None:
        _keep(self._labels, 0)
        for row, item in enumerate(items):
            x, y, z = item.center_m
            label = self._scene.add_label(
                f"{self._root}/name_{row}", name_and_size(item), anchor="bottom-center",
                position=(x, y + item.size_m[1] / 2 + 0.05, z),
            )  # fmt: skip
            self._labels.append(label)

    def _show_boxes(self, scene: Scene, drawn: list[int], kept: Collection[int]) -> None:
        _keep(self._lines, 0)
        if drawn:
            corners = box_corners(scene.centers_m[drawn], scene.sizes_m[drawn])
            colors = np.array([_KEPT if row in kept else _BOX for row in drawn], dtype=np.uint8)
            lines = self._scene.add_line_segments(
                f"{self._root}/boxes", corners[:, _EDGES].reshape(-1, 2, 3),
                np.repeat(colors, 2 * len(_EDGES), axis=0).reshape(-1, 2, 3), thickness=2,
                thickness_units="screen",
            )  # fmt: skip
            self._lines.append(lines)


def _keep(nodes: list[Any], count: int) -> None:
    """Remove all nodes but the first `count`."""
    for node in nodes[count:]:
        node.remove()
    del nodes[count:]


class Board:
    """The map of the latent space as a tilted square, for clicks and drags.

    Args:
        pointed: Called with a map point and the kind of event: `click`, `drag`, or `end` of a drag.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        latent_map: LatentMap,
        center_m: tuple[float, float, float],
        side_m: float,
        pointed: Callable[[Point, str], None],
    ):
        self.latent_map, self._center_m, self._side_m = latent_map, np.array(center_m), side_m
        cos, sin = math.cos(LEAN_RAD), math.sin(LEAN_RAD)
        self._rotation = np.array([[1.0, 0, 0], [0, cos, sin], [0, -sin, cos]])
        self._scene = scene = server.scene
        half_rad = LEAN_RAD / 2  # the board's normal, z, is tilted up from the room's z
        wxyz = (math.cos(half_rad), -math.sin(half_rad), 0.0, 0.0)
        scene.add_frame("/map", show_axes=False, wxyz=wxyz, position=center_m)
        face = scene.add_box(
            "/map/board", color=_BOARD, dimensions=(side_m, side_m, 0.02), position=(0, 0, -0.01)
        )
        # Dots are spheres, raised so that they do not intersect the board's face.
        scene.add_point_cloud(
            "/map/rooms", self.on_board(latent_map.rooms, 0.02 * side_m), np.array(_DOT),
            point_size=0.014 * side_m, point_shape="circle", point_shading="flat",
            precision="float32",
        )  # fmt: skip
        self._here = scene.add_icosphere(
            "/map/here", radius=0.022 * side_m, color=_HERE, visible=False
        )
        scene.add_label(
            "/map/name", f"latent space: {len(latent_map.rooms)} training rooms",
            anchor="bottom-center", position=(0, side_m / 2 + 0.05, 0),
        )  # fmt: skip

        @face.on_click
        async def _(event: Any) -> None:
            if (point := self.hit(event.ray_origin, event.ray_direction)) is not None:
                pointed(point, "click")

        # Asynchronous callbacks keep events in order; the work is done in a thread.
        @face.on_drag("left")
        async def _(event: Any) -> None:
            eye = event.client.camera.position
            point = self.hit(eye, np.array(event.end_position) - eye)
            if point is not None:
                pointed(point, "end" if event.phase == "end" else "drag")

    def on_board(
        self, places: Float[Tensor, "n 2"], above_m: float = 0.0
    ) -> Float[np.ndarray, "n 3"]:
        """Points of the map in the board's frame, `above_m` above its face."""
        middle = torch.tensor(self.latent_map.middle, dtype=places.dtype)
        flat = ((places - middle) / self.latent_map.side * self._side_m).double().numpy()
        return np.hstack([flat, np.full((len(flat), 1), above_m)])

    def in_scene(self, board_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points of the board's frame in scene coordinates."""
        return board_m @ self._rotation.T + self._center_m

    def corners_m(self) -> Float[np.ndarray, "4 3"]:
        """Corners of the board in scene coordinates."""
        half = self._side_m / 2
        return self.in_scene(np.array([[x, y, 0.0] for x in (-half, half) for y in (-half, half)]))

    def hit(self, origin_m: Any, direction: Any) -> Point | None:
        """The map point hit by a ray of the scene, clamped to the board's edge.

        None if the ray is parallel to the board or points away from it.
        """
        start = (np.asarray(origin_m, dtype=np.float64) - self._center_m) @ self._rotation
        way = np.asarray(direction, dtype=np.float64) @ self._rotation
        if start[2] * way[2] >= 0:
            return None
        flat = (start - way * (start[2] / way[2]))[:2] / self._side_m
        x, y = flat.clip(-0.5, 0.5) * self.latent_map.side + np.array(self.latent_map.middle)
        return (float(x), float(y))

    def mark(self, latent: np.ndarray | None) -> None:
        """Mark the point of a latent; None hides the mark."""
        self._here.visible = latent is not None
        if latent is not None:
            place = self.latent_map.place(torch.from_numpy(latent).unsqueeze(0))
            self._here.position = self.on_board(place, 0.02 * self._side_m)[0]

    def draw_path(self, z: Float[Tensor, "steps dimension"]) -> None:
        """Draw the line of a path, in place of the previous one."""
        points = self.on_board(self.latent_map.place(z), 0.03 * self._side_m)
        self._scene.add_line_segments(
            "/map/path", np.stack([points[:-1], points[1:]], axis=1), _PATH, thickness=3,
            thickness_units="screen",
        )  # fmt: skip

"""A room as viser scene nodes: meshes of objects, boxes as lines, names and sizes as labels."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sceneprior.core.geometry.corners import BOX_EDGES, box_corners
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.core.shell import ShellName, shell_meshes, shell_of
from sceneprior.render.appearance import object_colors, object_mesh, shell_color

if TYPE_CHECKING:
    import viser

_BOX, _KEPT = (120, 120, 120), (230, 120, 20)
_SAME = 1e-4
"""Maximum difference of vertices, relative to the box, at which meshes count as equal."""
_EDGES = np.array(BOX_EDGES)


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
        self._lines: Any = None
        self.frame = self._scene.add_frame(root, show_axes=False, position=(x_m, 0.0, 0.0))
        self._walls: list[Any] = []
        self._grid = self._scene.add_grid(
            f"{root}/grid", floor_m, floor_m, plane="xz", position=(0.0, -0.005, 0.0),
            plane_color=(236, 233, 226), plane_opacity=1.0, cell_color=(222, 218, 208),
            section_color=(196, 190, 178),
        )  # fmt: skip

    def show(
        self,
        scene: Scene,
        kept: Collection[int] = (),
        names: bool = False,
        boxes: bool = False,
        shell: ShellName = "none",
    ) -> None:
        """Show a scene in place of the previous one; objects that the user keeps get an orange box
        and a name. If neither floor nor walls are shown, a grid is."""
        self._show_shell(
            shell_of(scene).inner_meshes() if shell == "walls" else shell_meshes(scene, shell)
        )
        for row, (item, color) in enumerate(
            zip(scene.objects, object_colors(scene).tolist(), strict=True)
        ):
            self._show_object(row, item, tuple(color))
        for node in self._nodes[len(scene.objects) :]:
            node.handle.remove()
        del self._nodes[len(scene.objects) :]
        self._show_labels([
            item for row, item in enumerate(scene.objects) if names or row in kept
        ])  # fmt: skip
        self._show_boxes(scene, kept, boxes)

    def _show_object(self, row: int, item: SceneObject, color: tuple[int, int, int]) -> None:
        center, size = np.array(item.center_m), np.maximum(item.size_m, 1e-6)
        mesh = object_mesh(item)
        unit = (np.asarray(mesh.vertices_m) - center) / size
        old = self._nodes[row] if row < len(self._nodes) else None
        if old is not None and _alike(old, unit, mesh.faces, color):
            old.handle.position, old.handle.scale = center, tuple(size.tolist())
            return
        handle = self._scene.add_mesh_simple(
            f"{self._root}/object_{row}", unit, mesh.faces, color=color, flat_shading=True,
            side="double", position=center, scale=tuple(size.tolist()),
        )  # fmt: skip
        if self._clicked is not None:
            clicked = self._clicked
            handle.on_click(lambda _: clicked(row))
        self._nodes[row : row + 1] = [_Node(handle, unit, mesh.faces, color)]

    def _show_shell(self, meshes: Mapping[str, Mesh]) -> None:
        self._grid.visible = not meshes
        for node in self._walls:
            node.remove()
        self._walls = [
            self._scene.add_mesh_simple(
                f"{self._root}/{name}", mesh.vertices_m, mesh.faces,
                color=tuple(shell_color(name).tolist()),
                flat_shading=True, side="front", cast_shadow=False,
            )
            for name, mesh in meshes.items()
        ]  # fmt: skip

    def _show_labels(self, items: list[SceneObject]) -> None:
        for row, item in enumerate(items):
            x, y, z = item.center_m
            top = (x, y + item.size_m[1] / 2 + 0.05, z)
            if row < len(self._labels):
                self._labels[row].text, self._labels[row].position = name_and_size(item), top
            else:
                self._labels.append(
                    self._scene.add_label(
                        f"{self._root}/name_{row}", name_and_size(item), position=top,
                        anchor="bottom-center",
                    )
                )  # fmt: skip
        for label in self._labels[len(items) :]:
            label.remove()
        del self._labels[len(items) :]

    def _show_boxes(self, scene: Scene, kept: Collection[int], boxes: bool) -> None:
        drawn = [row for row in range(len(scene.objects)) if boxes or row in kept]
        if self._lines is not None:
            self._lines.remove()
            self._lines = None
        if drawn:
            corners = box_corners(scene.centers_m[drawn], scene.sizes_m[drawn])
            colors = np.array([_KEPT if row in kept else _BOX for row in drawn], dtype=np.uint8)
            self._lines = self._scene.add_line_segments(
                f"{self._root}/boxes", corners[:, _EDGES].reshape(-1, 2, 3),
                np.repeat(colors, 2 * len(_EDGES), axis=0).reshape(-1, 2, 3), thickness=2,
                thickness_units="screen",
            )  # fmt: skip


def _alike(old: _Node, unit: np.ndarray, faces: np.ndarray, color: tuple[int, int, int]) -> bool:
    return (
        old.color == color
        and old.unit.shape == unit.shape
        and np.array_equal(old.faces, faces)
        and bool(np.abs(old.unit - unit).max(initial=0) < _SAME)
    )

"""The page's 3D scene: a room, and to its left the board with the map of the latent space."""

import math
import threading
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.apps.retrieval.cad_models import CadModels, made_models
from sceneprior.apps.retrieval.retrieve import retrieve
from sceneprior.apps.viewer.explorer import (
    NOTHING_ASKED,
    Display,
    Explorer,
    Folder,
    LatentMap,
    Shown,
    name_and_size,
)
from sceneprior.core.boxes import BOX_EDGES, box_corners
from sceneprior.core.cameras import framed
from sceneprior.core.errors import InputError
from sceneprior.core.shell import ShellName, shell_meshes, shell_of
from sceneprior.render.appearance import object_colors, object_mesh, scene_meshes, shell_color

if TYPE_CHECKING:
    import viser

FOV_RAD = 0.75
"""Vertical field of view of the camera."""
CORNER = np.array([-0.42, -0.62, -0.66])
"""Viewing direction if only a room is shown, as in the pictures of rooms."""
FRONT = np.array([0.0, -0.6, -0.8])
"""Viewing direction if a room is shown beside the map, which faces the camera."""
FLOOR_M = 6.0
"""Least side of the floor beside which the board stands."""
GAP = 0.06
"""Gap between the floor and the board, relative to the floor's side."""
LEAN_RAD = math.radians(40)
"""Tilt of the board, about the elevation of the page's initial camera."""
_BOX, _KEPT = (120, 120, 120), (230, 120, 20)
_BOARD, _DOT, _PATH, _HERE = (244, 243, 238), (70, 92, 140), (214, 110, 30), (200, 30, 60)
WORKER = "sceneprior page"
"""Name of the thread that draws rooms."""
Point = tuple[float, float]
"""A point of the map."""


class Page:
    """The page without its panel (panel.py); all connected browsers share its single room.

    Args:
        models: CAD models for the display choice `models`; by default the package's own.
        asked: Request of the first room, as arguments of `Prior.sample`.
        shell: Parts of the shell (walls, floor) that are shown initially.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        source: Explorer | Folder,
        models: CadModels | None = None,
        asked: Mapping[str, Any] = NOTHING_ASKED,
        shell: ShellName = "walls",
    ):
        self.server, self.source, self.models = server, source, models or made_models()
        self.display = Display(shell)
        self.shown = source.room(0) if isinstance(source, Folder) else source.sample(0, None, asked)
        self.scene = self.shown.scene
        """The displayed scene: the scene of `shown`, with CAD models if they are chosen."""
        self.on_show: Callable[[], None] = lambda: None
        """Called after each change of the shown room."""
        self._lock = threading.RLock()
        self._newest: Callable[[], None] | None = None
        # Callbacks come from 32 threads of viser's; each that drew rooms would keep memory for it.
        self._worker = ThreadPoolExecutor(1, WORKER)
        self._nodes: dict[str, Any] = {}
        self._bounds_m = np.zeros((2, 3))
        """Lowest and highest corner that the cameras show."""
        floor_m = max(FLOOR_M, 2 * float(np.abs(self._room_points()[:, [0, 2]]).max()))
        self._grid = server.scene.add_grid(
            "/grid", floor_m, floor_m, plane="xz", position=(0.0, -0.005, 0.0),
            plane_color=(236, 233, 226), plane_opacity=1.0, cell_color=(222, 218, 208),
            section_color=(196, 190, 178),
        )  # fmt: skip
        self.board: Board | None = None
        """The map's board; None if the source has no map."""
        if isinstance(source, Explorer) and source.map is not None:
            self.board = Board(server, source.map, floor_m, self._pointed)
        server.scene.set_up_direction("+y")
        server.initial_camera.fov = FOV_RAD
        self.show(self.shown)
        server.on_client_connect(self._connected)

    def show(self, shown: Shown, settled: bool = True) -> None:
        """Show a room; slow updates are skipped during a drag, when it is not `settled`."""
        with self._lock:
            self.shown, self.scene = shown, shown.scene
            if settled and self.display.models:
                self.scene = retrieve(shown.scene, self.models)
            with self.server.atomic():
                self._draw()
                if self.board is not None:
                    self.board.mark(shown.scene.latent)
                self.on_show()
            points, (low, high) = self._room_points(), self._bounds_m
            if settled and ((points < low) | (points > high)).any():
                self.frame()

    def _draw(self) -> None:
        """Replace the nodes of the room; objects that the user keeps get an orange box and a
        name."""
        scene, display, add = self.scene, self.display, self.server.scene
        before, self._nodes = self._nodes, {}
        is_walled = display.shell == "walls"
        shell = shell_of(scene).inner_meshes() if is_walled else shell_meshes(scene, display.shell)
        self._grid.visible = not shell
        for name, part in shell.items():
            self._nodes[name] = add.add_mesh_simple(
                f"/room/{name}", part.vertices_m, part.faces, flat_shading=True, side="front",
                color=tuple(shell_color(name).tolist()), cast_shadow=False,
            )  # fmt: skip
        for row, (item, color) in enumerate(
            zip(scene.objects, object_colors(scene).tolist(), strict=True)
        ):
            mesh = object_mesh(item)
            node = add.add_mesh_simple(
                f"/room/object_{row}", np.asarray(mesh.vertices_m), mesh.faces, color=tuple(color),
                flat_shading=True, side="double",
            )  # fmt: skip
            node.on_click(self._toggler(row))
            self._nodes[f"object_{row}"] = node
            is_kept, (x, y, z) = row in self.shown.kept, item.center_m
            if display.names or is_kept:
                self._nodes[f"name_{row}"] = add.add_label(
                    f"/room/name_{row}", name_and_size(item), anchor="bottom-center",
                    position=(x, y + item.size_m[1] / 2 + 0.05, z),
                )  # fmt: skip
            if display.boxes or is_kept:
                (corners,) = box_corners(scene.centers_m[[row]], scene.sizes_m[[row]])
                self._nodes[f"box_{row}"] = add.add_line_segments(
                    f"/room/box_{row}", corners[np.array(BOX_EDGES)], _KEPT if is_kept else _BOX,
                    thickness=2, thickness_units="screen",
                )  # fmt: skip
        for name in before.keys() - self._nodes.keys():
            before[name].remove()

    def frame(self) -> None:
        """Move all cameras so that everything is visible."""
        points = self._room_points()
        self._bounds_m = np.stack([points.min(axis=0) - 0.05, points.max(axis=0) + 0.05])
        for client in self.server.get_clients().values():
            self._frame(client)

    def _connected(self, client: "viser.ClientHandle") -> None:
        """Frame the room in a new browser's window, and again when the window changes its shape."""
        aspect = 0.0

        def update(camera: Any) -> None:
            nonlocal aspect
            if abs(camera.aspect - aspect) > 0.01:
                aspect = camera.aspect
                self._frame(client)

        update(client.camera)
        client.camera.on_update(update)

    def _frame(self, client: "viser.ClientHandle") -> None:
        camera, points, direction = client.camera, self._room_points(), CORNER
        if self.board is not None:
            points, direction = np.concatenate([points, self.board.corners_m()]), FRONT
        with client.atomic():
            camera.position, camera.look_at = framed(points, direction, camera.fov, camera.aspect)

    def _room_points(self) -> Float[np.ndarray, "points 3"]:
        """Vertices of the furniture, and corners of the floor and of the walls if shown."""
        shell, points = shell_of(self.scene), [m.vertices_m for m in scene_meshes(self.scene)]
        for height_m in (0.0, shell.height_m)[: 1 + (self.display.shell == "walls")]:
            points.append(np.insert(shell.outline_m, 1, height_m, axis=1))
        return np.concatenate(points)

    def _toggler(self, item: int) -> Callable[[Any], None]:
        """The answer to a click on an object: keep it, or release it."""

        def toggle() -> None:
            if item < len(self.shown.scene.objects):
                self.show(self.shown.toggled(item))

        return lambda _: self.safely(toggle)

    def _pointed(self, point: Point, how: str) -> None:
        source = self.source
        assert isinstance(source, Explorer), "only a prior has a map"
        self.follow(lambda: self.show(source.at(self.shown, point, how == "click"), how != "drag"))

    def follow(self, task: Callable[[], None]) -> None:
        """Queue a task, replacing one that has not started, so that the room keeps up with the
        pointer."""

        def do_newest() -> None:
            newest, self._newest = self._newest, None
            if newest is not None:
                self.safely(newest)

        self._newest = task
        self._worker.submit(do_newest)

    def safely(self, task: Callable[[], None]) -> None:
        """Run a browser's request in the page's thread, and wait for it; errors are shown as
        notifications."""
        if not threading.current_thread().name.startswith(WORKER):  # a callback may trigger another
            self._worker.submit(self.safely, task).result()
            return
        try:
            with self._lock:
                task()
        except Exception as error:
            known = isinstance(error, (InputError, FloatingPointError))
            if not known:
                traceback.print_exc()
            title = "That does not work" if known else f"{type(error).__name__}: please report it"
            for client in self.server.get_clients().values():
                client.add_notification(title, str(error), color="red", auto_close_seconds=20)


class Board:
    """The map of the latent space as a tilted square to the left of a floor, for clicks and drags.

    Args:
        floor_m: Side of the floor.
        pointed: Called with a map point and the kind of event: `click`, `drag`, or `end` of a drag.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        latent_map: LatentMap,
        floor_m: float,
        pointed: Callable[[Point, str], None],
    ):
        self.latent_map, self._side_m = latent_map, (side_m := 0.85 * floor_m)
        x_m = -floor_m / 2 - GAP * floor_m - side_m / 2
        self._center_m = np.array([x_m, 0.4 * side_m, -0.1 * floor_m])
        cos, sin = math.cos(LEAN_RAD), math.sin(LEAN_RAD)
        self._rotation = np.array([[1.0, 0, 0], [0, cos, sin], [0, -sin, cos]])
        self._scene = scene = server.scene
        half_rad = LEAN_RAD / 2  # the board's normal, z, is tilted up from the room's z
        wxyz = (math.cos(half_rad), -math.sin(half_rad), 0.0, 0.0)
        scene.add_frame("/map", show_axes=False, wxyz=wxyz, position=self._center_m)
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

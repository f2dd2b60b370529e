"""The page's 3D scene: a room with its doors and windows, in each browser's view."""

import threading
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sceneprior.apps.retrieval.cad_models import CadModels, made_models
from sceneprior.apps.viewer.explorer import Explorer
from sceneprior.apps.viewer.shown import NOTHING_ASKED, Folder, Shown, name_and_size
from sceneprior.apps.viewer.views import FOV_RAD, VIEWS, View, overview, room_points, walker
from sceneprior.core.boxes import BOX_EDGES, box_corners
from sceneprior.core.errors import InputError
from sceneprior.core.shell import THICK_M, Shell, ShellName, Wall, shell_meshes, shell_of
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.render.appearance import object_colors, object_mesh, shell_color

if TYPE_CHECKING:
    import viser

_BOX, _PICKED, _LOCKED = (120, 120, 120), (40, 90, 170), (230, 120, 20)
_EDGE = (168, 162, 150)
_OPENINGS = {"door": (176, 132, 92), "window": (150, 186, 212)}
WORKER = "sceneprior page"
"""Name of the thread that draws rooms."""


class Page:
    """The page without its panel (panel.py); all connected browsers share its single room.

    Args:
        models: CAD models for `replace_by_models`; by default the package's own.
        request: Request of the first room.
        shell: Parts of the shell (walls, floor) that are shown initially.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        source: Explorer | Folder,
        models: CadModels | None = None,
        request: RoomRequest = NOTHING_ASKED,
        shell: ShellName = "walls",
    ):
        self.server, self.source, self.models = server, source, models or made_models()
        self.shell, self.names, self.boxes = shell, False, False
        """Parts of the shell that are shown, a grid if none is; and choices to show names and boxes
        of all objects."""
        first = source.room(0) if isinstance(source, Folder) else source.sample(0, None, request)
        self.shown = first
        self.before: list[Shown] = []
        """States to which `undo` returns, the newest last."""
        self._settled = self.shown
        self.on_show: Callable[[], None] = lambda: None
        """Called after each change of the shown room."""
        self.on_drop: Callable[[int, float, float], None] = self.drop
        self.tell: Callable[[str], None] = lambda _: None
        """Shows an error, or nothing if it is empty."""
        self._lock = threading.RLock()
        self._newest: Callable[[], None] | None = None
        # Callbacks come from 32 threads of viser's; each that drew rooms would keep memory for it.
        self._worker = ThreadPoolExecutor(1, WORKER)
        self._nodes: dict[str, Any] = {}
        self._views: dict[int, View] = {}
        self._framed_m = np.zeros((0, 2))
        """Outline of the floor that the cameras show."""
        self._grid = server.scene.add_grid(
            "/grid", 40.0, 40.0, plane="xz", position=(0.0, -0.005, 0.0),
            cell_color=(222, 218, 208), section_color=(196, 190, 178),
        )  # fmt: skip
        server.scene.set_up_direction("+y")
        server.initial_camera.fov = FOV_RAD[VIEWS[0]]
        self._light()
        self.show(self.shown, remember=False)
        server.on_client_connect(self._connected)

    def _light(self) -> None:
        """Light by which colours are as in the pictures of rooms, on paper instead of white."""
        scene = self.server.scene
        scene.set_background_image(
            np.full((2, 2, 3), (241, 239, 234), dtype=np.uint8), format="png"
        )
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=False)
        scene.add_light_hemisphere("/sky", ground_color=(190, 184, 176), intensity=2.3)
        self.sun = scene.add_light_directional(
            "/sun", intensity=1.6, cast_shadow=True, position=(3.0, 8.0, 5.0)
        )

    # -- The room ------------------------------------------------------------------------------

    def show(self, shown: Shown, settled: bool = True, remember: bool = True) -> None:
        """Show a room. During a drag over the map it is not `settled`; `remember` keeps the room
        before it for `undo`."""
        with self._lock:
            if settled and remember:
                self.before = [*self.before[-49:], self._settled]
            self.shown = shown
            if settled:
                self._settled = shown
            with self.server.atomic():
                self._draw()
                self.on_show()
            outline_m = shell_of(shown.scene).outline_m
            if settled and not np.array_equal(outline_m, self._framed_m):
                self._framed_m = outline_m
                self.frame()

    def undo(self) -> None:
        """Return to the state before the last change."""
        if not self.before:
            raise InputError("There is nothing to undo.")
        self.show(self.before.pop(), remember=False)

    def _draw(self) -> None:
        """Replace the nodes of the room."""
        scene = self.shown.scene
        before, self._nodes = self._nodes, {}
        shell = shell_of(scene)
        is_walled = self.shell == "walls"
        meshes = shell.inner_meshes() if is_walled else shell_meshes(scene, self.shell)
        self._grid.visible = not meshes
        for name, part in meshes.items():
            self._mesh(name, part.vertices_m, part.faces, tuple(shell_color(name).tolist()))
        if is_walled:
            self._draw_edges(shell)
        for row, color in enumerate(object_colors(scene).tolist()):
            self._draw_object(row, tuple(color))
        for name in before.keys() - self._nodes.keys():
            before[name].remove()

    def _mesh(self, name: str, vertices_m: Any, faces: Any, color: Any, **more: Any) -> Any:
        options: dict[str, Any] = {"side": "front", "cast_shadow": False} | more
        self._nodes[name] = node = self.server.scene.add_mesh_simple(
            f"/room/{name}", np.asarray(vertices_m), np.asarray(faces), color=color,
            flat_shading=True, **options,
        )  # fmt: skip
        return node

    def _lines(self, name: str, segments_m: Any, color: Any, thickness: int = 2) -> None:
        self._nodes[name] = self.server.scene.add_line_segments(
            f"/room/{name}", np.asarray(segments_m), color, thickness=thickness,
            thickness_units="screen",
        )  # fmt: skip

    def _draw_edges(self, shell: Shell) -> None:
        """Outlines of the walls, and doors and windows in them. Only the inner faces of walls are
        drawn, so of a wall between the camera and the room, these remain."""
        edges = []
        for wall in shell.walls:
            whole = _upright(wall, (0.0, wall.length_m, 0.0, shell.height_m + THICK_M))
            edges += [whole[[0, 1]], whole[[2, 3]], whole[[0, 3]]]
            for opening in wall.openings:
                kind = "door" if opening[2] < 0.05 else "window"
                corners, name = _upright(wall, opening), f"{kind}_{len(self._nodes)}"
                faces, color = np.array([[0, 1, 2], [0, 2, 3]]), _OPENINGS[kind]
                normal = np.cross(*(corners[1:3] - corners[0]))
                if normal[[0, 2]] @ wall.inward < 0:
                    faces = faces[:, ::-1]
                self._mesh(name, corners, faces, color, opacity=None if kind == "door" else 0.75)
                self._mesh(f"{name}_back", corners, faces[:, ::-1], color, opacity=0.3)
                ring = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
                self._lines(f"{name}_frame", ring, tuple(c // 2 for c in color), 3)
        self._lines("edges", edges, _EDGE)

    def _draw_object(self, row: int, color: tuple[int, ...]) -> None:
        """An object, which a click picks and a drag moves. A picked or locked one has a name and a
        box."""
        scene, shown = self.shown.scene, self.shown
        item = scene.objects[row]
        mesh, is_picked, is_locked = object_mesh(item), row == shown.picked, row in shown.locked
        node = self._mesh(
            f"object_{row}", mesh.vertices_m, mesh.faces, color, side="double", cast_shadow=True,
            receive_shadow=False,  # a surface would shade itself in stripes
        )  # fmt: skip
        node.on_click(lambda _: self.safely(lambda: self.pick(row)))
        node.on_drag("left")(self._dragger(row))
        if self.names or is_picked or is_locked:
            (x, y, z), lock = item.center_m, "🔒 " * is_locked
            self._nodes[f"name_{row}"] = self.server.scene.add_label(
                f"/room/name_{row}", lock + name_and_size(item), anchor="bottom-center",
                position=(x, y + item.size_m[1] / 2 + 0.05, z),
            )  # fmt: skip
        if self.boxes or is_picked or is_locked:
            (corners,) = box_corners(scene.centers_m[[row]], scene.sizes_m[[row]])
            box_color = _LOCKED if is_locked else _PICKED if is_picked else _BOX
            self._lines(f"box_{row}", corners[np.array(BOX_EDGES)], box_color)

    def pick(self, row: int) -> None:
        """Pick an object, or none if it was picked."""
        if row < len(self.shown.scene.objects):
            picked = None if row == self.shown.picked else row
            self.show(replace(self.shown, picked=picked), remember=False)

    def _dragger(self, row: int) -> Callable[[Any], Any]:
        """The answer to a drag of an object: it follows the pointer along the floor, and
        `on_drop` goes on where it is dropped."""
        grabbed, moved_m = np.zeros(3), np.zeros(3)

        # Asynchronous callbacks keep events in order; the work is done in a thread.
        async def dragged(event: Any) -> None:
            eye = np.array(event.client.camera.position)
            if event.phase == "start":
                grabbed[:], moved_m[:] = event.start_position, 0.0
            way = np.array(event.end_position) - eye
            if (height_m := grabbed[1] - eye[1]) * way[1] > 0:  # not above the horizon
                moved_m[:] = eye + way * (height_m / way[1]) - grabbed
            for name in (f"object_{row}", f"box_{row}"):
                if name in self._nodes:
                    self._nodes[name].position = (moved_m[0], 0.0, moved_m[2])
            if event.phase == "end":
                x_m, _, z_m = moved_m.tolist()
                self.follow(lambda: self.on_drop(row, x_m, z_m))

        return dragged

    def drop(self, row: int, x_m: float, z_m: float) -> None:
        """Move a dragged object to where it was dropped."""
        if row < len(self.shown.scene.objects):
            self.show(self.shown.dragged(row, x_m, z_m))

    def replace_by_models(self) -> None:
        """Show a CAD model in place of the picked object, or of all."""
        self.show(self.shown.with_models(self.models))

    # -- Cameras -------------------------------------------------------------------------------

    def look(self, view: View, client: Any) -> None:
        """Show the room from outside, from above, or from inside, in one browser."""
        self._views[client.client_id] = view
        self._frame(client)

    def frame(self) -> None:
        """Move all cameras so that the whole room is visible in their views."""
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
        camera, view = client.camera, self._views.get(client.client_id, VIEWS[0])
        if view == "Walk in":
            eye, target = walker(self.shown.scene)
        else:
            points_m = room_points(self.shown.scene, self.shell == "walls")
            eye, target = overview(points_m, view, camera.image_width, camera.image_height)
        with client.atomic():
            for aside in (1e-2, 0.0):  # viser does not send what equals an old report
                camera.fov = FOV_RAD[view] + aside
                camera.position, camera.look_at = eye + aside, target + aside

    # -- Work ----------------------------------------------------------------------------------

    def follow(self, task: Callable[[], None], tell: Callable[[str], None] | None = None) -> None:
        """Queue a task, replacing one that has not started, so that the room keeps up with the
        pointer."""

        def do_newest() -> None:
            newest, self._newest = self._newest, None
            if newest is not None:
                self.safely(newest, tell)

        self._newest = task
        self._worker.submit(do_newest)

    def safely(self, task: Callable[[], None], tell: Callable[[str], None] | None = None) -> None:
        """Run a browser's request in the page's thread, and wait for it.

        Args:
            tell: Shows an error beside the control; by default `self.tell`.
        """
        if not threading.current_thread().name.startswith(WORKER):  # a callback may trigger another
            self._worker.submit(self.safely, task, tell).result()
            return
        tell = tell or self.tell
        try:
            with self._lock:
                tell("")
                task()
        except Exception as error:
            text = str(error)
            if not isinstance(error, (InputError, FloatingPointError)):
                traceback.print_exc()
                text = f"{type(error).__name__}: {error}. Please report it."
            tell(text)


def _upright(wall: Wall, extent: tuple[float, ...]) -> Float[np.ndarray, "4 3"]:
    """Corners of a rectangle on a wall's inner face: start and end along it, bottom and top."""
    start, end, low, high = extent
    flat = [wall.start_m + wall.direction * at for at in (start, end, end, start)]
    return np.array([(x, y, z) for (x, z), y in zip(flat, (low, low, high, high), strict=True)])

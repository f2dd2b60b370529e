"""The viewer's page: a room, the map to its left, the nearest training room to its right."""

import threading
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sceneprior.apps.retrieval.cad_models import CadModels, made_models
from sceneprior.apps.retrieval.retrieve import retrieve
from sceneprior.apps.viewer.board import Board, BoardPlane, Point
from sceneprior.apps.viewer.explorer import NOTHING_ASKED, Explorer, Folder, Shown, floor_side_m
from sceneprior.apps.viewer.framing import (
    ASPECT,
    CORNER,
    FOV_RAD,
    FRONT,
    box_points,
    framed,
    room_bounds,
    viewing_direction,
)
from sceneprior.apps.viewer.nodes import RoomNodes
from sceneprior.apps.viewer.panel import MODELS, Panel
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.core.shell import ShellName, shell_of

if TYPE_CHECKING:
    import viser

GAP = 0.06
"""Gap between the room and its neighbours, relative to the width of the room's floor."""
SMALL = 0.55
"""The cameras are framed again if the room's sides fall below this share of the framed box's."""


class Page:
    """The page, whose single room is shared by all connected browsers.

    Args:
        models: CAD models for the choice `models` of `Furniture`; by default the package's own.
        asked: Request of the first room, as arguments of `Prior.sample`.
        shell: Parts of the shell (walls, floor) that are shown initially.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        source: Explorer | Folder,
        title: str,
        models: CadModels | None = None,
        asked: Mapping[str, Any] = NOTHING_ASKED,
        shell: ShellName = "walls",
    ):
        self.server, self.source, self.models = server, source, models or made_models()
        self.explorer = source if isinstance(source, Explorer) else None
        self.shown = source.room(0) if isinstance(source, Folder) else source.sample(0, None, asked)
        self.scene = self.shown.scene
        """The displayed scene: the scene of `shown`, with CAD models if they are chosen."""
        # Callbacks come from many threads, and a callback may trigger another in its own thread.
        self._lock = threading.RLock()
        self._newest: Callable[[], None] | None = None
        self._follower = ThreadPoolExecutor(1)
        self._floor_m = floor_m = floor_side_m(source.some_layouts())
        self._room = RoomNodes(server, "/room", 0.0, floor_m, self._clicked)
        self._beside_m = floor_m * (1 + GAP)
        self._beside = RoomNodes(server, "/nearest", self._beside_m, floor_m)
        self._beside.frame.visible = False
        self.board: Board | None = None
        """The map's board; None if the source has no map."""
        if self.explorer is not None and self.explorer.map is not None:
            side = 0.85 * floor_m
            center = (-floor_m / 2 - GAP * floor_m - side / 2, 0.4 * side, -0.1 * floor_m)
            plane = BoardPlane(self.explorer.map, center, side)
            self.board = Board(server, plane, self._pointed)
        self._bounds_m = np.zeros((2, 3))
        """Lowest and highest corner of the room when it was framed."""
        self._eyes: dict[int, np.ndarray] = {}
        """Last position that was set for each browser's camera."""
        server.scene.set_up_direction("+y")
        server.initial_camera.fov = FOV_RAD
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.set_panel_label(title)
        server.gui.main_panel.dock_right()
        self.panel = Panel(self, asked, shell)
        self.show(self.shown)
        server.on_client_connect(self._connected)

    def show(self, shown: Shown, settled: bool = True) -> None:
        """Show a room; slow updates are skipped during a drag, when it is not `settled`."""
        with self._lock:
            panel = self.panel
            self.shown = shown
            self.scene = shown.scene
            if settled and panel.furniture.value == MODELS:
                self.scene = retrieve(shown.scene, self.models)
            with self.server.atomic():
                self._room.show(
                    self.scene, shown.kept, panel.names.value, panel.boxes.value, panel.shell.value
                )
                if self.board is not None:
                    self.board.mark(shown.scene.latent)
                panel.describe(shown, self.scene)
            if settled and panel.nearest is not None:
                self._show_nearest(self.scene if panel.nearest.value else None)
            if settled and self._is_framed_badly():
                self.frame()

    # -- Cameras -----------------------------------------------------------------------------------

    def frame(self, turned: bool = False) -> None:
        """Move all cameras so that everything is visible.

        Args:
            turned: Use the page's viewing direction instead of each camera's current one.
        """
        self._bounds_m = self._room_bounds()
        points_m = self._points()
        eye, target = framed(points_m, self._direction, FOV_RAD, ASPECT)
        self.server.initial_camera.position = eye
        self.server.initial_camera.look_at = target
        for client in self.server.get_clients().values():
            self._place(client, points_m, self._direction if turned else None)

    @property
    def _direction(self) -> Float[np.ndarray, "3"]:
        return CORNER if self.board is None else FRONT

    def _place(
        self,
        client: "viser.ClientHandle",
        points_m: Float[np.ndarray, "points 3"],
        forward: Float[np.ndarray, "3"] | None,
    ) -> None:
        camera = client.camera
        if forward is None:
            forward = viewing_direction(np.asarray(camera.wxyz))
            if abs(forward[1]) > 0.99:
                forward = self._direction
        eye, target = framed(points_m, forward, camera.fov, camera.aspect)
        self._eyes[client.client_id] = eye
        with client.atomic():
            camera.position, camera.look_at = eye, target

    def _connected(self, client: "viser.ClientHandle") -> None:
        """Frame the room in a new browser's window, and again when the window changes its shape."""
        aspect = 0.0

        def update(camera: Any) -> None:
            nonlocal aspect
            own = self._eyes.get(client.client_id)
            reshaped = abs(camera.aspect - aspect) > 0.01
            aspect = camera.aspect
            if own is None or (reshaped and np.allclose(camera.position, own, atol=0.02)):
                self._place(client, self._points(), self._direction)

        update(client.camera)
        client.camera.on_update(update)

    def _points(self) -> Float[np.ndarray, "points 3"]:
        """Points that cameras must show: the room, the map, and the nearest training room if
        shown."""
        points = [box_points(self._room_bounds())]
        half = self._floor_m / 2
        if self.board is not None:
            points.append(self.board.plane.corners_m())
            points.append(np.array([[x, 0.0, z] for x in (-half, half) for z in (-half, half)]))
        if self._beside.frame.visible:
            beside = [[self._beside_m + x, y, z] for x in (-half, half) for z in (-half, half)
                      for y in (0.0, 2.0)]  # fmt: skip
            points.append(np.array(beside))
        return np.concatenate(points)

    def _room_bounds(self) -> Float[np.ndarray, "2 3"]:
        return room_bounds(self.scene, shell_of(self.scene), self.panel.shell.value == "walls")

    def _is_framed_badly(self) -> bool:
        low, high = self._room_bounds()
        framed_low, framed_high = self._bounds_m
        outside = (low < framed_low - 0.05).any() or (high > framed_high + 0.05).any()
        return bool(outside or ((high - low) < SMALL * (framed_high - framed_low))[[0, 2]].any())

    # -- Events ------------------------------------------------------------------------------------

    def _show_nearest(self, scene: Scene | None) -> None:
        assert self.explorer is not None
        changed = self._beside.frame.visible != (scene is not None)
        self._beside.frame.visible = scene is not None
        room, distance_m = (None, 0.0) if scene is None else self.explorer.nearest(scene)
        self.panel.describe_nearest(room, distance_m)
        if room is not None:
            panel = self.panel
            self._beside.show(
                room.scene, (), panel.names.value, panel.boxes.value, panel.shell.value
            )
        if changed:
            self.frame()

    def _clicked(self, item: int) -> None:
        def keep() -> None:
            if item < len(self.shown.scene.objects):
                self.show(self.shown.toggled(item))

        self.safely(keep)

    def _pointed(self, point: Point, how: str) -> None:
        explorer = self.explorer
        assert explorer is not None, "only a prior has a map"
        self.follow(
            lambda: self.show(explorer.at(self.shown, point, how == "click"), how != "drag")
        )

    def follow(self, task: Callable[[], None]) -> None:
        """Queue a task, replacing one that has not started, so that the room keeps up with the
        pointer."""
        self._newest = task
        self._follower.submit(self._do_newest)

    def _do_newest(self) -> None:
        task, self._newest = self._newest, None
        if task is not None:
            self.safely(task)

    def safely(self, task: Callable[[], None]) -> None:
        """Run a browser's request under the lock; errors are shown as notifications."""
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

"""The viewer's 3D scene: a room, the map to its left, the nearest training room to its right."""

import threading
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sceneprior.apps.retrieval.cad_models import CadModels, made_models
from sceneprior.apps.retrieval.retrieve import retrieve
from sceneprior.apps.viewer.explorer import NOTHING_ASKED, Explorer, Folder, Shown, floor_side_m
from sceneprior.apps.viewer.scene_nodes import Board, Display, Point, RoomNodes
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.core.shell import ShellName, shell_of
from sceneprior.render.appearance import scene_meshes

if TYPE_CHECKING:
    import viser

FOV_RAD = 0.75
"""Vertical field of view of the camera."""
ASPECT = 1.3
"""Width-to-height ratio of the window, until a browser reports its own."""
CORNER = np.array([-0.42, -0.62, -0.66])
"""Viewing direction if only a room is shown, as in the pictures of rooms."""
FRONT = np.array([0.0, -0.6, -0.8])
"""Viewing direction if a room is shown beside the map, which faces the camera."""
MARGIN = 0.92
"""Share of the window that the points may fill."""
GAP = 0.06
"""Gap between the room and its neighbours, relative to the width of the room's floor."""
SMALL = 0.55
"""The cameras are framed again if the room's sides fall below this share of the framed box's."""


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
        self.nearest: tuple[Shown, float] | None = None
        """The training room beside the room, and its distance in metres, if it is shown."""
        self.on_show: Callable[[], None] = lambda: None
        """Called after each change of the shown room."""
        # Callbacks come from many threads, and a callback may trigger another in its own thread.
        self._lock = threading.RLock()
        self._newest: Callable[[], None] | None = None
        self._follower = ThreadPoolExecutor(1)
        self._floor_m = floor_m = floor_side_m(source.layouts())
        self._room = RoomNodes(server, "/room", 0.0, floor_m, self._clicked)
        self._beside_m = floor_m * (1 + GAP)
        self._beside = RoomNodes(server, "/nearest", self._beside_m, floor_m)
        self._beside.frame.visible = False
        self.board: Board | None = None
        """The map's board; None if the source has no map."""
        if isinstance(source, Explorer) and source.map is not None:
            side = 0.85 * floor_m
            center = (-floor_m / 2 - GAP * floor_m - side / 2, 0.4 * side, -0.1 * floor_m)
            self.board = Board(server, source.map, center, side, self._pointed)
        self._direction = CORNER if self.board is None else FRONT
        self._bounds_m = np.zeros((2, 3))
        """Lowest and highest corner of the room when it was framed."""
        self._eyes: dict[int, np.ndarray] = {}
        """The place to which the page has moved each browser's camera."""
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
                self._room.show(self.scene, self.display, shown.kept)
                if self.board is not None:
                    self.board.mark(shown.scene.latent)
                self.on_show()
            if settled:
                self._show_nearest()
                if self._is_framed_badly():
                    self.frame()

    def _show_nearest(self) -> None:
        """Show the training room nearest to the room, or hide it."""
        before, self.nearest = self.nearest, None
        if self.display.nearest and isinstance(self.source, Explorer):
            self.nearest = self.source.nearest(self.scene)
            self._beside.show(self.nearest[0].scene, self.display)
        self._beside.frame.visible = self.nearest is not None
        if (before is None) != (self.nearest is None):
            self.frame()
        self.on_show()

    # -- Cameras -----------------------------------------------------------------------------------

    def frame(self, turned: bool = False) -> None:
        """Move all cameras so that everything is visible.

        Args:
            turned: Use the page's viewing direction instead of each camera's current one.
        """
        self._bounds_m = self._room_bounds()
        camera = self.server.initial_camera
        camera.position, camera.look_at = framed(self._points(), self._direction, FOV_RAD, ASPECT)
        for client in self.server.get_clients().values():
            self._place(client, turned)

    def _place(self, client: "viser.ClientHandle", turned: bool) -> None:
        from viser.transforms import SO3

        camera = client.camera
        forward = SO3(np.asarray(camera.wxyz)).as_matrix()[:, 2]
        if turned or abs(forward[1]) > 0.99:
            forward = self._direction
        with client.atomic():
            eye, camera.look_at = framed(self._points(), forward, camera.fov, camera.aspect)
            camera.position = self._eyes[client.client_id] = eye

    def _connected(self, client: "viser.ClientHandle") -> None:
        """Frame the room in a new browser's window, and again when the window changes its shape,
        unless the user has moved the camera."""
        aspect = 0.0

        def update(camera: Any) -> None:
            nonlocal aspect
            own = self._eyes.get(client.client_id)
            reshaped = abs(camera.aspect - aspect) > 0.01
            aspect = camera.aspect
            if own is None or (reshaped and np.allclose(camera.position, own, atol=0.02)):
                self._place(client, turned=True)

        update(client.camera)
        client.camera.on_update(update)

    def _points(self) -> Float[np.ndarray, "points 3"]:
        """Points that cameras must show: the room, the map, and the room beside it if shown."""
        points, half = [box_points(self._room_bounds())], self._floor_m / 2
        if self.board is not None:
            points += [
                self.board.corners_m(), box_points(np.array([[-half, 0, -half], [half, 0, half]]))
            ]  # fmt: skip
        if self._beside.frame.visible:
            x_m = self._beside_m
            points.append(box_points(np.array([[x_m - half, 0, -half], [x_m + half, 2, half]])))
        return np.concatenate(points)

    def _room_bounds(self) -> Float[np.ndarray, "2 3"]:
        return room_bounds(self.scene, self.display.shell == "walls")

    def _is_framed_badly(self) -> bool:
        low, high = self._room_bounds()
        framed_low, framed_high = self._bounds_m
        outside = (low < framed_low - 0.05).any() or (high > framed_high + 0.05).any()
        return bool(outside or ((high - low) < SMALL * (framed_high - framed_low))[[0, 2]].any())

    # -- Events ------------------------------------------------------------------------------------

    def _clicked(self, item: int) -> None:
        def keep() -> None:
            if item < len(self.shown.scene.objects):
                self.show(self.shown.toggled(item))

        self.safely(keep)

    def _pointed(self, point: Point, how: str) -> None:
        source = self.source
        assert isinstance(source, Explorer), "only a prior has a map"
        self.follow(lambda: self.show(source.at(self.shown, point, how == "click"), how != "drag"))

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


def framed(
    points_m: Float[np.ndarray, "points 3"],
    forward: Float[np.ndarray, "3"],
    fov_rad: float,
    aspect: float,
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Position and target of the nearest camera that sees all points, with y up.

    Args:
        forward: Viewing direction, not straight up or down.
        fov_rad: Vertical field of view.
        aspect: Width-to-height ratio of the window.
    """
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    upward = np.cross(right, forward)
    depth = points_m @ forward
    slope = MARGIN * np.tan(fov_rad / 2)
    # A camera at depth -away sees a point if |across - middle| <= slope * (depth + away).
    middle, away = [], []
    for across, own in ((points_m @ right, slope * aspect), (points_m @ upward, slope)):
        high, low = (across - own * depth).max(), (-across - own * depth).max()
        middle.append((high - low) / 2)
        away.append((high + low) / 2 / own)
    eye = middle[0] * right + middle[1] * upward - max(away) * forward
    return eye, eye + (depth.mean() + max(away)) * forward


def room_bounds(scene: Scene, walls: bool) -> Float[np.ndarray, "2 3"]:
    """The lowest and highest corner of a room's floor, furniture and, if shown, walls."""
    shell = shell_of(scene)
    points = [mesh.vertices_m for mesh in scene_meshes(scene)]
    for height_m in (0.0, shell.height_m)[: 1 + walls]:
        points.append(np.insert(shell.outline_m, 1, height_m, axis=1))
    every = np.concatenate(points)
    return np.stack([every.min(axis=0), every.max(axis=0)])


def box_points(bounds_m: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "8 3"]:
    """The eight corners of a box, from its lowest and highest corner."""
    return np.stack(np.meshgrid(*bounds_m.T), axis=-1).reshape(8, 3)

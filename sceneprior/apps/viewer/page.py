"""The viewer's page: a room, its cameras, and the requests of browsers."""

import threading
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sceneprior.apps.retrieval.cad_models import CadModels
from sceneprior.apps.retrieval.made_models import made_models
from sceneprior.apps.retrieval.retrieve import retrieve
from sceneprior.apps.viewer.explorer import NOTHING_ASKED, Explorer, Folder, Shown
from sceneprior.apps.viewer.framing import (
    ASPECT,
    CORNER,
    DOWN,
    FOV_RAD,
    box_points,
    framed,
    room_bounds,
    viewing_direction,
)
from sceneprior.apps.viewer.nodes import RoomNodes
from sceneprior.apps.viewer.panel import MODELS, Panel
from sceneprior.apps.viewer.plan import Plan
from sceneprior.core.errors import InputError
from sceneprior.core.shell import ShellName, shell_of

if TYPE_CHECKING:
    import viser

AROUND_PLAN_M = 1.0
"""Floor shown around a plan that is being drawn."""
SMALL = 0.55
"""A room with sides below this share of those of the framed box is framed anew."""


class Page:
    """The page, whose single room is shared by all connected browsers.

    Args:
        models: CAD models, the other choice of `Furniture`; by default the package's own.
        asked: Request of the first room, as arguments of `Prior.sample`.
        shell: Parts of the room itself that are shown at first.
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
        self.shown = source.room(0) if isinstance(source, Folder) else source.sample(0, None, asked)
        self.scene = self.shown.scene
        """The displayed scene: the scene of `shown`, with CAD models if they are chosen."""
        # Callbacks come from many threads, and a callback may trigger another in its own thread.
        self._lock = threading.RLock()
        self._newest: Callable[[], None] | None = None
        self._follower = ThreadPoolExecutor(1)
        self._room = RoomNodes(server, self._clicked)
        self._bounds_m = np.zeros((2, 3))
        """Lowest and highest corner of the room when it was framed."""
        self._eyes: dict[int, np.ndarray] = {}
        """Position that each browser's camera was given last."""
        server.scene.set_up_direction("+y")
        server.initial_camera.fov = FOV_RAD
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.set_panel_label(title)
        server.gui.main_panel.dock_right()
        self.panel = Panel(self, asked, shell)
        self.show(self.shown)
        server.on_client_connect(self._connected)

    def show(self, shown: Shown) -> None:
        """Show a room."""
        with self._lock:
            panel = self.panel
            self.shown = shown
            self.scene = shown.scene
            if panel.furniture.value == MODELS:
                self.scene = retrieve(shown.scene, self.models)
            with self.server.atomic():
                self._room.show(
                    self.scene, shown.kept, panel.names.value, panel.boxes.value, panel.shell.value
                )
                panel.describe(shown, self.scene)
            if self._is_framed_badly():
                self.frame()

    def draw(self, plan: Plan | None) -> None:
        """Show a plan to draw on, from above, in place of the room; None shows the room again."""
        self._room.frame.visible = plan is None
        if plan is None:
            self.frame(True)
        else:
            self._look(self._plan_points(plan), DOWN)

    # -- Cameras -----------------------------------------------------------------------------------

    def frame(self, turned: bool = False) -> None:
        """Move all cameras so that everything is seen.

        Args:
            turned: Look in the page's own direction, not in that of each camera.
        """
        self._bounds_m = self._room_bounds()
        self._look(box_points(self._bounds_m), CORNER if turned else None)

    def _look(
        self, points_m: Float[np.ndarray, "points 3"], forward: Float[np.ndarray, "3"] | None
    ) -> None:
        eye, target = framed(points_m, CORNER, FOV_RAD, ASPECT)
        self.server.initial_camera.position = eye
        self.server.initial_camera.look_at = target
        for client in self.server.get_clients().values():
            self._place(client, points_m, forward)

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
                forward = CORNER
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
            if own is None or (
                abs(camera.aspect - aspect) > 0.01 and np.allclose(camera.position, own, atol=0.02)
            ):
                aspect = camera.aspect
                plan = self.panel.plan
                if plan is None:
                    self._place(client, box_points(self._room_bounds()), CORNER)
                else:
                    self._place(client, self._plan_points(plan), DOWN)
            else:
                aspect = camera.aspect

        update(client.camera)
        client.camera.on_update(update)

    def _plan_points(self, plan: Plan) -> Float[np.ndarray, "points 3"]:
        low, high = plan.outline_m.min(axis=0), plan.outline_m.max(axis=0)
        grown = np.array([low - AROUND_PLAN_M, high + AROUND_PLAN_M])
        return box_points(np.insert(grown, 1, 0.0, axis=1))

    def _room_bounds(self) -> Float[np.ndarray, "2 3"]:
        return room_bounds(self.scene, shell_of(self.scene), self.panel.shell.value == "walls")

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

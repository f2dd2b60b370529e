"""The viewer's page: a room, the map to its left, the nearest training room to its right."""

import threading
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from sceneprior.apps.retrieval.cad_models import CadModels
from sceneprior.apps.retrieval.made_models import made_models
from sceneprior.apps.retrieval.retrieve import retrieve
from sceneprior.apps.viewer.board import Board, BoardPlane, Point
from sceneprior.apps.viewer.explorer import HERE, PATH_STEPS, Explorer, Folder, Shown, floor_side_m
from sceneprior.apps.viewer.nodes import RoomNodes, name_and_size
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.render.scene_files import scene_to_glb

if TYPE_CHECKING:
    import viser

FOV_RAD = 0.75
"""Vertical field of view of the camera."""
GAP = 0.06
"""Gap between the room and its neighbours, relative to the width of the room's floor."""
FURNITURE = DECODED, MODELS = "decoded", "models"
"""The choices of `Furniture`: meshes of the prior or the files, or CAD models."""
_TEXT = Markup('<div style="padding: 0 0.8em 0.8em; font-size: 0.875em">{}</div>')


class Page:
    """The page, whose single room is shared by all connected browsers.

    Without `models`, the package's own furniture is the other choice of `Furniture`.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        source: Explorer | Folder,
        title: str,
        models: CadModels | None = None,
    ):
        self.server, self.source, self.models = server, source, models or made_models()
        self.explorer = source if isinstance(source, Explorer) else None
        self.shown = source.room(0) if isinstance(source, Folder) else source.sample(0)
        self.scene = self.shown.scene
        """The displayed scene: the scene of `shown`, with CAD models if they are chosen."""
        # Callbacks come from many threads, and a callback may trigger another in its own thread.
        self._lock = threading.RLock()
        self._newest: Callable[[], None] | None = None
        self._follower = ThreadPoolExecutor(1)
        floor_m = floor_side_m(source.some_layouts())
        self._room = RoomNodes(server, "/room", 0.0, floor_m, self._clicked)
        self._beside_m = floor_m * (1 + GAP)
        self._beside = RoomNodes(server, "/nearest", self._beside_m, floor_m)
        self._beside.frame.visible = False
        self.board: Board | None = None
        """The map's board; None if the source has no map."""
        self._left_m, self._right_m = -floor_m / 2, floor_m / 2
        if self.explorer is not None and self.explorer.map is not None:
            side = 0.85 * floor_m
            self._left_m -= floor_m * GAP + side
            center = (self._left_m + side / 2, 0.4 * side, -0.1 * floor_m)
            plane = BoardPlane(self.explorer.map, center, side)
            self.board = Board(server, plane, self._pointed)
        server.scene.set_up_direction("+y")
        eye, target = self._view(self._right_m)
        server.initial_camera.fov = FOV_RAD
        server.initial_camera.position, server.initial_camera.look_at = eye, target
        server.gui.set_panel_label(title)
        server.gui.main_panel.dock_right()
        self._add_controls()
        self.show(self.shown)

    def show(self, shown: Shown, settled: bool = True) -> None:
        """Show a room; slow updates are skipped during a drag, when it is not `settled`."""
        with self._lock:
            self.shown = shown
            self.scene = shown.scene
            if settled and self._furniture.value == MODELS:
                self.scene = retrieve(shown.scene, self.models)
            with self.server.atomic():
                self._room.show(self.scene, shown.kept, self._names.value, self._boxes.value)
                if self.board is not None:
                    self.board.mark(shown.scene.latent)
                self._said.content = _html(_words(shown, self.scene))
            if settled and self._nearest is not None:
                self._show_nearest(self.scene if self._nearest.value else None)

    def _show_nearest(self, scene: Scene | None) -> None:
        assert self.explorer is not None
        if self._beside.frame.visible != (scene is not None):
            self._beside.frame.visible = scene is not None
            eye, target = self._view(self._right_m + (self._beside_m if scene else 0.0))
            for client in self.server.get_clients().values():
                client.camera.position, client.camera.look_at = eye, target
        self._nearest_said.content = ""
        if scene is not None:
            room, distance_m = self.explorer.nearest(scene)
            self._beside.show(room.scene, names=self._names.value, boxes=self._boxes.value)
            said = f"Right: {room.origin}; {distance_m:.2f} m away in layout."
            self._nearest_said.content = _html(said)

    def _clicked(self, item: int) -> None:
        def keep() -> None:
            if item < len(self.shown.scene.objects):
                self.show(self.shown.toggled(item))

        self._safely(keep)

    def _pointed(self, point: Point, how: str) -> None:
        explorer = self.explorer
        assert explorer is not None, "only a prior has a map"
        self._follow(
            lambda: self.show(explorer.at(self.shown, point, how == "click"), how != "drag")
        )

    def _follow(self, task: Callable[[], None]) -> None:
        """Queue a task, replacing one that has not started, so that the room keeps up with the
        pointer."""
        self._newest = task
        self._follower.submit(self._do_newest)

    def _do_newest(self) -> None:
        task, self._newest = self._newest, None
        if task is not None:
            self._safely(task)

    def _safely(self, task: Callable[[], None]) -> None:
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

    def _view(self, right_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Camera position and target that show everything from the left edge to `right_m`."""
        width = right_m - self._left_m
        middle = np.array([(right_m + self._left_m) / 2, 0.0, 0.0])
        return middle + 1.02 * width * np.array([0.0, 0.6, 0.8]), middle

    # -- The panel ---------------------------------------------------------------------------------

    def _add_controls(self) -> None:
        gui = self.server.gui
        self._said = gui.add_html("")
        if isinstance(self.source, Folder):
            self._add_folder(self.source)
        else:
            self._add_sampling(self.source)
            if self.source.map is not None:
                share = f"{self.source.map.share:.0%}"
                gui.add_markdown(
                    "**Map**: drag over the board, or click a dot, which is a training room. The "
                    "map shows the two directions in which the training rooms' latents differ "
                    f"most ({share} of the variance); all other coordinates stay."
                )
            elif self.source.without_map:
                gui.add_html(_html(self.source.without_map))
            if self.source.has_latents:
                self._add_path(self.source)
                self._add_completion(self.source)
        with gui.add_folder("Show"):
            self._names = self._box("Names and sizes", False)
            self._boxes = self._box("Boxes", False)
            self._furniture: Any = gui.add_dropdown("Furniture", FURNITURE, initial_value=DECODED)
            self._furniture.on_update(lambda _: self._safely(lambda: self.show(self.shown)))
            self._nearest: Any = None
            if self.board is not None:
                self._nearest = self._box("Nearest training room", False)
                self._nearest_said = gui.add_html("")
        self._buttons({"Download GLB": self._download})

    def _box(self, name: str, value: bool) -> Any:
        box = self.server.gui.add_checkbox(name, value)
        box.on_update(lambda _: self._safely(lambda: self.show(self.shown)))
        return box

    def _buttons(self, tasks: dict[str, Callable[[], None]]) -> None:
        group = self.server.gui.add_button_group("", tuple(tasks))
        group.on_click(lambda _: self._safely(tasks[group.value]))

    def _add_folder(self, folder: Folder) -> None:
        names = [scene.name for scene in folder.scenes]
        if len(names) < 2:
            return
        gui = self.server.gui
        number: Any = gui.add_slider("Room", min=1, max=len(names), step=1, initial_value=1)
        number.on_update(lambda _: self._follow(lambda: self.show(folder.room(number.value - 1))))

        def turn(by: int) -> None:
            number.value = 1 + (number.value - 1 + by) % len(names)

        self._buttons({"Previous": lambda: turn(-1), "Next": lambda: turn(1)})

    def _add_sampling(self, explorer: Explorer) -> None:
        gui = self.server.gui
        with gui.add_folder("New room"):
            known = explorer.distributions
            origin = gui.add_dropdown("From", known, initial_value=known[0]) if known else None
            seed: Any = gui.add_number("Seed", 0, min=0, step=1)

            def sample() -> None:
                self.show(explorer.sample(seed.value, None if origin is None else origin.value))

            def another() -> None:
                seed.value += 1  # the update triggers `sample`

            for each in (seed, origin):
                if each is not None:
                    each.on_update(lambda _: self._safely(sample))
            self._buttons({"Sample": sample, "Next seed": another})

    def _add_path(self, explorer: Explorer) -> None:
        gui = self.server.gui
        with gui.add_folder("Path"):
            hint = f"A training room's id, seed:7, or {HERE}"
            start = gui.add_text("From", "seed:1", hint=hint)
            end = gui.add_text("To", "seed:2", hint=hint)
            step: Any = gui.add_slider(
                "Step", min=0, max=PATH_STEPS - 1, step=1, initial_value=0, disabled=True
            )

            def draw() -> None:
                z = explorer.draw_path(self.shown, start.value, end.value)
                if self.board is not None:
                    self.board.draw_path(z)
                step.disabled = False
                step.value = 0
                self.show(explorer.step(0))

            def walk() -> None:
                settled = step.value in (0, PATH_STEPS - 1)
                if explorer.path is not None:
                    self.show(explorer.step(step.value), settled)

            step.on_update(lambda _: self._follow(walk))
            self._buttons({"Draw path": draw})

    def _add_completion(self, explorer: Explorer) -> None:
        gui = self.server.gui
        with gui.add_folder("Complete"):
            gui.add_markdown("Click objects to keep them; all others are replaced by new ones.")
            seed: Any = gui.add_number("Seed ", 0, min=0, step=1)

            def complete() -> None:
                self.show(explorer.complete(self.shown, seed.value))
                seed.value += 1

            self._buttons({"Complete the rest": complete})

    def _download(self) -> None:
        self.server.send_file_download(f"{self.scene.name}.glb", scene_to_glb(self.scene))


def _words(shown: Shown, scene: Scene) -> Markup:
    """Panel text on the shown room: its origin and its objects, with kept objects in bold."""
    lines = [
        Markup("<li><b>{}</b></li>" if row in shown.kept else "<li>{}</li>").format(
            name_and_size(item)
        )
        for row, item in enumerate(scene.objects)
    ]
    rows = Markup().join(lines) or Markup("<li>nothing: an empty room</li>")
    return Markup('<b>{}</b><ul style="margin: 0.4em 0; padding-left: 1.4em">{}</ul>').format(
        shown.origin, rows
    )


def _html(text: str) -> str:
    """Text for the panel, escaped unless it is `Markup`.

    Names from files are shown only by this function, never as Markdown: viser executes HTML in
    Markdown, and reads its images from the server's files.
    """
    return str(_TEXT.format(text))

"""The page's control panel: new rooms, requests, paths, completion, display and downloads."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from sceneprior.apps.viewer.asking import RequestFields
from sceneprior.apps.viewer.downloads import FORMATS, download
from sceneprior.apps.viewer.explorer import HERE, PATH_STEPS, Explorer, Folder, Shown
from sceneprior.apps.viewer.words import error_words, html, room_words, wish_words
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.core.shell import SHELLS, ShellName

if TYPE_CHECKING:
    from sceneprior.apps.viewer.page import Page

FURNITURE = DECODED, MODELS = "decoded", "models"
"""The choices of `Furniture`: the meshes of the prior or the scene files, or CAD models."""


class Panel:
    """The control panel of a page, with the descriptions of the shown room and its wishes."""

    def __init__(self, page: "Page", asked: Mapping[str, Any], shell: ShellName):
        self._page, self._gui = page, page.server.gui
        self._said = self._gui.add_html("")
        self._answer: Any = None
        self._fields: RequestFields | None = None
        source = page.source
        if isinstance(source, Folder):
            self._add_folder(source)
        else:
            self._add_sampling(source, asked)
        self._add_show(shell)
        self._add_download()
        if isinstance(source, Explorer):
            if source.has_latents:
                self._add_completion(source)
            self._add_map(source)
            if source.has_latents:
                self._add_path(source)

    def describe(self, shown: Shown, scene: Scene) -> None:
        """Describe the shown room and its wishes."""
        self._said.content = html(room_words(shown, scene))
        if self._answer is not None:
            self._answer.content = html(wish_words(scene))

    def describe_nearest(self, room: Shown | None, distance_m: float) -> None:
        """Describe the nearest training room; None if it is not shown."""
        told = "" if room is None else f"Right: {room.origin}; {distance_m:.2f} m away in layout."
        self._nearest_said.content = html(told) if told else ""

    def _add_folder(self, folder: Folder) -> None:
        names = [scene.name for scene in folder.scenes]
        self._answer = self._gui.add_html("")
        if len(names) < 2:
            return
        page = self._page
        number: Any = self._gui.add_slider("Room", min=1, max=len(names), step=1, initial_value=1)
        number.on_update(lambda _: page.follow(lambda: page.show(folder.room(number.value - 1))))

        def turn(by: int) -> None:
            number.value = 1 + (number.value - 1 + by) % len(names)

        self._buttons({"Previous": lambda: turn(-1), "Next": lambda: turn(1)})

    def _add_sampling(self, explorer: Explorer, asked: Mapping[str, Any]) -> None:
        gui, page = self._gui, self._page
        with gui.add_folder("New room"):
            known = explorer.distributions
            if explorer.takes_requests:
                self._fields = RequestFields(page.server, asked, page.safely)
            origin = gui.add_dropdown("From", known, initial_value=known[0]) if known else None
            seed: Any = gui.add_number("Seed", 0, min=0, step=1)

            def sample() -> None:
                self._sample(explorer, seed.value, None if origin is None else origin.value)

            def another() -> None:
                seed.value += 1  # the update triggers `sample`

            for each in (seed, origin):
                if each is not None:
                    each.on_update(lambda _: page.safely(sample))
            gui.add_button("Make room").on_click(lambda _: page.safely(sample))
            gui.add_button("Next seed").on_click(lambda _: page.safely(another))
            self._answer = gui.add_html("")

    def _sample(self, explorer: Explorer, seed: int, distribution: str | None) -> None:
        """Show a new room, or the reason why the request cannot be met."""
        try:
            asked = {} if self._fields is None else self._fields.asked()
            if asked:
                self._answer.content = html("Looking for a room ...")
            shown = explorer.sample(seed, distribution, asked)
        except InputError as error:
            self._answer.content = html(error_words(str(error)))
            raise
        self._page.show(shown)

    def _add_map(self, explorer: Explorer) -> None:
        if explorer.map is None:
            self._gui.add_html(html(explorer.without_map))
            return
        self._gui.add_markdown(
            "**Map**: drag over the board, or click a dot, which is a training room. The map shows "
            "the two directions in which the training rooms' latents differ most "
            f"({explorer.map.share:.0%} of the variance); all other coordinates stay."
        )

    def _add_path(self, explorer: Explorer) -> None:
        gui, page = self._gui, self._page
        with gui.add_folder("Path", expand_by_default=False):
            hint = f"A training room's id, {HERE}, or paper:7 (New room's seed 7 from paper)"
            start = gui.add_text("From", "paper:1", hint=hint)
            end = gui.add_text("To", "paper:2", hint=hint)
            step: Any = gui.add_slider(
                "Step", min=0, max=PATH_STEPS - 1, step=1, initial_value=0, disabled=True
            )

            def draw() -> None:
                z = explorer.draw_path(page.shown, start.value, end.value)
                if page.board is not None:
                    page.board.draw_path(z)
                step.disabled = False
                step.value = 0
                page.show(explorer.step(0))

            def walk() -> None:
                settled = step.value in (0, PATH_STEPS - 1)
                if explorer.path is not None:
                    page.show(explorer.step(step.value), settled)

            step.on_update(lambda _: page.follow(walk))
            self._buttons({"Draw path": draw})

    def _add_completion(self, explorer: Explorer) -> None:
        gui, page = self._gui, self._page
        with gui.add_folder("Complete"):
            told = " The wishes above hold for the whole room." if explorer.takes_requests else ""
            gui.add_markdown(
                f"Click objects to keep them; all others are replaced by new ones.{told}"
            )
            seed: Any = gui.add_number("Seed ", 0, min=0, step=1)

            def complete() -> None:
                want = "" if self._fields is None else self._fields.want.value.strip()
                page.show(explorer.complete(page.shown, seed.value, want))
                seed.value += 1

            self._buttons({"Complete the rest": complete})

    def _add_show(self, shell: ShellName) -> None:
        gui, page = self._gui, self._page
        with gui.add_folder("Show"):
            self.shell: Any = gui.add_dropdown(
                "Shell", SHELLS, initial_value=shell,
                hint="Floor and walls, the floor, or neither; in downloads, too",
            )  # fmt: skip
            self.shell.on_update(lambda _: page.safely(lambda: page.show(page.shown)))
            self.names = self._box("Names and sizes", False)
            self.boxes = self._box("Boxes", False)
            self.furniture: Any = gui.add_dropdown("Furniture", FURNITURE, initial_value=DECODED)
            self.furniture.on_update(lambda _: page.safely(lambda: page.show(page.shown)))
            self.nearest: Any = None
            if page.board is not None:
                self.nearest = self._box("Nearest training room", False)
                self._nearest_said = gui.add_html("")
            self._buttons({"Whole room in view": lambda: page.frame(True)})

    def _box(self, name: str, value: bool) -> Any:
        page = self._page
        box = self._gui.add_checkbox(name, value)
        box.on_update(lambda _: page.safely(lambda: page.show(page.shown)))
        return box

    def _add_download(self) -> None:
        with self._gui.add_folder("Download"):
            form: Any = self._gui.add_dropdown("Format", FORMATS)
            button = self._gui.add_button("Download")
            button.on_click(
                lambda event: self._page.safely(lambda: self._send(form.value, event.client))
            )

    def _send(self, form: str, client: Any) -> None:
        """Send the displayed room to the browser that asked for it."""
        name, content, notes = download(self._page.scene, form, self.shell.value)
        client.send_file_download(name, content, save_immediately=True)
        if notes:
            client.add_notification("Note", " ".join(notes), auto_close_seconds=20)

    def _buttons(self, tasks: dict[str, Callable[[], None]]) -> None:
        group = self._gui.add_button_group("", tuple(tasks))
        group.on_click(lambda _: self._page.safely(tasks[group.value]))

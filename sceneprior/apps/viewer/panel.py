"""The page's control panel: new rooms, requests, paths, completion, display and downloads."""

import io
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from sceneprior.apps.retrieval.cad_models import CadModels
from sceneprior.apps.viewer.explorer import HERE, NOTHING_ASKED, PATH_STEPS, Explorer, Folder
from sceneprior.apps.viewer.page import Page
from sceneprior.apps.viewer.panel_html import error_html, html, room_html, wishes_html
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.core.shell import SHELLS, ShellName
from sceneprior.interchange.export import SIMULATORS, export_scenes
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.render.scene_files import check_names, save

if TYPE_CHECKING:
    import viser

FURNITURE = DECODED, MODELS = "decoded", "models"
"""The choices of `Furniture`: the meshes of the prior or the scene files, or CAD models."""
FORMATS = {
    "GLB": ".glb", "JSON": ".json", "OBJ": "obj", "USD": "usd", "MuJoCo (MJCF)": "mujoco",
    "Habitat": "habitat", "SceneEval": "sceneeval", "ATISS": "atiss", "3D-FRONT": "threed-front",
}  # fmt: skip
"""Formats of downloads: endings for `save`, or formats of `export_scenes`."""
_FIELDS = {
    "floor": ("Floor", "4x3 (metres), or corners: 0,0 5,0 5,3 2,3 2,5 0,5. Empty: any floor."),
    "openings": ("Doors", "door, window@north, door@0:1.5 (1.5 m along the wall from corner 0)"),
    "want": ("Wishes", "a double bed and two nightstands beside it; or nightstand: 2, desk: 0"),
    "ceiling_m": ("Ceiling", "Height in metres"),
}
"""Name and hint of each text field of a request."""


def open_page(
    server: "viser.ViserServer",
    source: Explorer | Folder,
    title: str,
    models: CadModels | None = None,
    asked: Mapping[str, Any] = NOTHING_ASKED,
    shell: ShellName = "walls",
) -> "Panel":
    """A page with its panel; see `Page` for the arguments."""
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.set_panel_label(title)
    server.gui.main_panel.dock_right()
    return Panel(Page(server, source, models, asked, shell), asked)


class Panel:
    """The controls of a page, with descriptions of the shown room and its wishes."""

    def __init__(self, page: Page, asked: Mapping[str, Any] = NOTHING_ASKED):
        self.page, self._gui = page, page.server.gui
        self._room_text = self._gui.add_html("")
        self._wishes_text: Any = None
        self._nearest_text: Any = None
        self.request: RequestFields | None = None
        source = page.source
        if isinstance(source, Folder):
            self._add_folder(source)
        else:
            self._add_sampling(source, asked)
        self._add_show()
        self._add_download()
        if isinstance(source, Explorer):
            self._add_map(source)
            if source.has_latents:
                self._add_path(source)
        page.on_show = self._describe
        self._describe()

    def _describe(self) -> None:
        """Describe the shown room, its wishes, and the nearest training room."""
        page = self.page
        self._room_text.content = html(room_html(page.shown, page.scene))
        if self._wishes_text is not None:
            self._wishes_text.content = html(wishes_html(page.scene))
        if self._nearest_text is not None:
            self._nearest_text.content = ""
            if page.nearest is not None:
                room, distance_m = page.nearest
                text = f"Right: {room.origin}; {distance_m:.2f} m away in layout."
                self._nearest_text.content = html(text)

    def _add_folder(self, folder: Folder) -> None:
        count = len(folder.scenes)
        self._wishes_text = self._gui.add_html("")
        if count < 2:
            return
        page = self.page
        number: Any = self._gui.add_slider("Room", min=1, max=count, step=1, initial_value=1)
        number.on_update(lambda _: page.follow(lambda: page.show(folder.room(number.value - 1))))

        def turn(by: int) -> None:
            number.value = 1 + (number.value - 1 + by) % count

        self._buttons({"Previous": lambda: turn(-1), "Next": lambda: turn(1)})

    def _add_sampling(self, explorer: Explorer, asked: Mapping[str, Any]) -> None:
        gui, page = self._gui, self.page
        with gui.add_folder("New room"):
            known = explorer.distributions
            if explorer.takes_requests:
                self.request = request = RequestFields(gui, asked)
                clear = gui.add_button("Clear the request", color="gray")
                clear.on_click(lambda _: page.safely(request.clear))
            origin = gui.add_dropdown("From", known, initial_value=known[0]) if known else None
            seed: Any = gui.add_number("Seed", 0, min=0, step=1)

            def sample() -> None:
                self.sample(explorer, seed.value, None if origin is None else origin.value)

            def another() -> None:
                seed.value += 1  # the update triggers `sample`

            for each in (seed, origin):
                if each is not None:
                    each.on_update(lambda _: page.safely(sample))
            gui.add_button("Make room").on_click(lambda _: page.safely(sample))
            gui.add_button("Next seed").on_click(lambda _: page.safely(another))
            if explorer.takes_requests:
                again: Any = gui.add_number("Completion", 0, min=0, step=1, hint="Its seed")
                complete = gui.add_button(
                    "Complete the rest",
                    hint="Click objects to keep them; all others are replaced by new ones",
                )

                def completed() -> None:
                    page.show(explorer.complete(page.shown, again.value, request.text("want")))
                    again.value += 1

                complete.on_click(lambda _: page.safely(completed))
            self._wishes_text = gui.add_html("")

    def sample(self, explorer: Explorer, seed: int, distribution: str | None) -> None:
        """Show a new room, or the reason why the request cannot be met."""
        try:
            asked = {} if self.request is None else self.request.asked()
            if asked:
                self._wishes_text.content = html("Looking for a room ...")
            shown = explorer.sample(seed, distribution, asked)
        except InputError as error:
            self._wishes_text.content = html(error_html(str(error)))
            raise
        self.page.show(shown)

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
        gui, page = self._gui, self.page
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

    def _add_show(self) -> None:
        gui, page = self._gui, self.page
        with gui.add_folder("Show"):
            self.shell = self._choice(
                "shell", gui.add_dropdown(
                    "Shell", SHELLS, initial_value=page.display.shell,
                    hint="Floor and walls, the floor, or neither; in downloads, too",
                ),
            )  # fmt: skip
            self.names = self._choice("names", gui.add_checkbox("Names and sizes", False))
            self._choice("boxes", gui.add_checkbox("Boxes", False))
            self.furniture = self._choice(
                "models", gui.add_dropdown("Furniture", FURNITURE, initial_value=DECODED),
                lambda value: value == MODELS,
            )  # fmt: skip
            if page.board is not None:
                self._choice("nearest", gui.add_checkbox("Nearest training room", False))
                self._nearest_text = gui.add_html("")
            self._buttons({"Whole room in view": lambda: page.frame(True)})

    def _choice(
        self, name: str, control: Any, convert: Callable[[Any], Any] = lambda value: value
    ) -> Any:
        """Let a control choose the value `name` of the page's display."""
        page = self.page

        def chosen() -> None:
            setattr(page.display, name, convert(control.value))
            page.show(page.shown)

        control.on_update(lambda _: page.safely(chosen))
        return control

    def _add_download(self) -> None:
        with self._gui.add_folder("Download"):
            form: Any = self._gui.add_dropdown("Format", tuple(FORMATS))
            button = self._gui.add_button("Download")

            def send(client: Any) -> None:
                name, content, notes = download(
                    self.page.scene, form.value, self.page.display.shell
                )
                client.send_file_download(name, content, save_immediately=True)
                if notes:
                    client.add_notification("Note", " ".join(notes), auto_close_seconds=20)

            button.on_click(lambda event: self.page.safely(lambda: send(event.client)))

    def _buttons(self, tasks: dict[str, Callable[[], None]]) -> None:
        group = self._gui.add_button_group("", tuple(tasks))
        group.on_click(lambda _: self.page.safely(tasks[group.value]))


class RequestFields:
    """Text fields of a request.

    Args:
        asked: The initial request; parts without a text field stay in every request until `clear`.
    """

    def __init__(self, gui: Any, asked: Mapping[str, Any]):
        texts = {key: value for key, value in asked.items() if isinstance(value, str | float | int)}
        self._rest = {key: value for key, value in asked.items() if key not in texts}
        self.fields: dict[str, Any] = {
            key: gui.add_text(label, str(texts.get(key, "")), multiline=key == "want", hint=hint)
            for key, (label, hint) in _FIELDS.items()
        }
        names = ", ".join(key.removesuffix("_m") for key in self._rest)
        rest = html(f"The command also requests: {names}.")
        self.rest_text = gui.add_html(rest, visible=bool(self._rest))

    def text(self, key: str) -> str:
        """The text of a field, without commas after the last door."""
        text = str(self.fields[key].value).strip()
        return text.strip(",") if key == "openings" else text

    def asked(self) -> dict[str, Any]:
        """The request as arguments of `Prior.sample`; texts that name files are refused.

        Raises:
            InputError: a field cannot be read.
        """
        asked = self._rest | {key: text for key in self.fields if (text := self.text(key))}
        if ceiling := self.text("ceiling_m").removesuffix("m"):
            try:
                asked["ceiling_m"] = float(ceiling)
            except ValueError:
                raise InputError(
                    f"The ceiling is '{ceiling[:40]}'; expected its height in metres, such as 2.6."
                ) from None
        return RoomRequest.of(**asked).parts()

    def clear(self) -> None:
        """Empty all fields, and drop the parts without a field."""
        for field in self.fields.values():
            field.value = ""
        self._rest, self.rest_text.visible = {}, False


def download(scene: Scene, form: str, shell: ShellName) -> tuple[str, bytes, list[str]]:
    """The name of a room's file, its bytes, and notes for the user; several files are zipped.

    Args:
        form: One of `FORMATS`.
        shell: Parts of the room itself to write, in the formats that leave a choice.

    Raises:
        InputError: the room cannot be written, or a package for it is not installed.
    """
    check_names([scene])
    to, notes = FORMATS[form], []
    with TemporaryDirectory() as name:
        folder = Path(name)
        if to.startswith("."):
            save(scene, folder / f"{scene.name}{to}", shell=shell)
        else:
            chosen = shell if to in (*SIMULATORS, "obj") else None
            notes = export_scenes([scene], to, folder, chosen)
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        if len(files) == 1 and files[0].parent == folder:
            return files[0].name, files[0].read_bytes(), notes
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:
            for path in files:
                # The entry has no date of today, so that the same room is the same file.
                entry = zipfile.ZipInfo(path.relative_to(folder).as_posix())
                archive.writestr(entry, path.read_bytes(), zipfile.ZIP_DEFLATED)
    return f"{scene.name}_{to}.zip", packed.getvalue(), notes

"""The page's control panel: new rooms, requests, paths, completion, display and downloads."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from sceneprior.apps.retrieval.cad_models import CadModels
from sceneprior.apps.viewer.explorer import (
    FORMATS,
    HERE,
    NOTHING_ASKED,
    PATH_STEPS,
    Explorer,
    Folder,
    Shown,
    download,
    name_and_size,
)
from sceneprior.apps.viewer.page import Page
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.core.shell import SHELLS, ShellName
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.render.appearance import object_colors

if TYPE_CHECKING:
    import viser

_TEXT = Markup('<div style="padding: 0 0.8em 0.8em; font-size: 0.875em">{}</div>')
_LIST = Markup(
    '<ul style="margin: 0.4em 0; padding: 0; list-style: none; max-height: 13.5em; '
    'overflow-y: auto">{}</ul>'
)
_SWATCH = Markup(
    '<span style="display: inline-block; width: 0.8em; height: 0.8em; margin-right: 0.5em; '
    'border-radius: 2px; background: rgb({}, {}, {})"></span>'
)
_WORSE = Markup('<span style="color: #c02020">{}</span>')
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
        self.request: RequestFields | None = None
        source = page.source
        if isinstance(source, Folder):
            self._add_folder(source)
        else:
            self._add_sampling(source, asked)
        self._add_show()
        self._add_download()
        if isinstance(source, Explorer):
            if source.map is None:
                self._gui.add_html(html(source.without_map))
            else:
                self._gui.add_markdown(
                    "**Map**: drag over the board, or click a dot, which is a training room. The "
                    "map shows the two directions in which the training rooms' latents differ most "
                    f"({source.map.share:.0%} of the variance); all other coordinates stay."
                )
            if source.has_latents:
                self._add_path(source)
        page.on_show = self._describe
        self._describe()

    def _describe(self) -> None:
        """Describe the shown room and its wishes."""
        self._room_text.content = html(room_html(self.page.shown, self.page.scene))
        if self._wishes_text is not None:
            self._wishes_text.content = html(wishes_html(self.page.scene))

    def _add_folder(self, folder: Folder) -> None:
        count = len(folder.scenes)
        self._wishes_text = self._gui.add_html("")
        if count < 2:
            return
        page = self.page
        number: Any = self._gui.add_slider("Room", min=1, max=count, step=1, initial_value=1)
        number.on_update(
            lambda _: page.follow(lambda: page.show(folder.room(value_of(number) - 1)))
        )

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
                self.sample(explorer, seed.value, None if origin is None else value_of(origin))

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
            self._wishes_text.content = html(_WORSE.format(error))
            raise
        self.page.show(shown)

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
                if explorer.path is not None:
                    place = value_of(step)
                    page.show(explorer.step(place), place in (0, PATH_STEPS - 1))

            step.on_update(lambda _: page.follow(walk))
            self._buttons({"Draw path": draw})

    def _add_show(self) -> None:
        gui, page = self._gui, self.page
        with gui.add_folder("Show"):
            choice = gui.add_dropdown(
                "Shell", SHELLS, initial_value=page.display.shell,
                hint="Floor and walls, the floor, or neither; in downloads, too",
            )  # fmt: skip
            self._choice("shell", choice)
            self._choice("names", gui.add_checkbox("Names and sizes", False))
            self._choice("boxes", gui.add_checkbox("Boxes", False))
            self._choice("models", gui.add_checkbox("CAD models", False))
            self._buttons({"Whole room in view": lambda: page.frame()})

    def _choice(self, name: str, control: Any) -> None:
        """Let a control choose the value `name` of the page's display."""
        page = self.page

        def chosen() -> None:
            setattr(page.display, name, value_of(control))
            page.show(page.shown)

        control.on_update(lambda _: page.safely(chosen))

    def _add_download(self) -> None:
        with self._gui.add_folder("Download"):
            form: Any = self._gui.add_dropdown("Format", tuple(FORMATS))
            button = self._gui.add_button("Download")

            def send(client: Any) -> None:
                shown, shell = self.page.scene, self.page.display.shell
                name, content, notes = download(shown, value_of(form), shell)
                client.send_file_download(name, content, save_immediately=True)
                if notes:
                    client.add_notification("Note", " ".join(notes), auto_close_seconds=20)

            button.on_click(lambda event: self.page.safely(lambda: send(event.client)))

    def _buttons(self, tasks: dict[str, Callable[[], None]]) -> None:
        group = self._gui.add_button_group("", tuple(tasks))
        group.on_click(lambda _: self.page.safely(lambda: tasks[value_of(group)]()))


def value_of(control: Any) -> Any:
    """The value of a control; a client may send any, and one that is not offered is an
    InputError."""
    value, most = control.value, getattr(control, "max", None)
    known = (value,) if most is None else range(control.min, most + 1)
    if value not in (known := getattr(control, "options", known)):
        words = ", ".join(map(str, known)) if len(known) < 12 else f"{known[0]} to {known[-1]}"
        raise InputError(f"'{str(value)[:40]}' is not offered here; choose from {words}.")
    return value


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


def html(text: str) -> str:
    """Text for the panel, escaped unless it is `Markup`.

    Names from files are shown only by this function, never as Markdown: viser executes HTML in
    Markdown, and reads its images from the server's files.
    """
    return str(_TEXT.format(text))


def room_html(shown: Shown, scene: Scene) -> Markup:
    """The shown room: its origin, its floor, and its objects in the colours of their classes, with
    kept objects in bold."""
    lines = []
    for row, (item, color) in enumerate(
        zip(scene.objects, object_colors(scene).tolist(), strict=True)
    ):
        name = Markup("<b>{}</b>" if row in shown.kept else "{}").format(name_and_size(item))
        lines.append(Markup("<li>{}{}</li>").format(_SWATCH.format(*color), name))
    rows = Markup().join(lines) or Markup("<li>nothing: an empty room</li>")
    floor = Markup()
    if scene.floor_m is not None:
        x, z = np.ptp(scene.floor_m, axis=0)
        parts = [f"{x:.2f} x {z:.2f} m"]
        for kind in ("door", "window"):
            if count := sum(each.kind == kind for each in scene.openings):
                parts.append(f"{count} {kind}{'s' * (count > 1)}")
        floor = Markup("<br>Floor: {}").format(", ".join(parts))
    return Markup("<b>{}</b>{}{}").format(shown.origin, floor, _LIST.format(rows))


def wishes_html(scene: Scene) -> Markup:
    """The wishes of a requested room, each marked as fulfilled or not."""
    wishes: Any = scene.extra.get("wishes")
    if not isinstance(wishes, list) or not wishes:  # a file may hold anything
        return Markup()
    lines = []
    for each in wishes:
        if isinstance(each, dict):
            wish = str(each.get("wish")).replace("_", " ")
            holds = each.get("holds") is True
            text = f"✓ {wish}" if holds else _WORSE.format(f"✗ {wish}: not fulfilled")
            lines.append(Markup("<li>{}</li>").format(text))
    return Markup("<b>Wishes</b>{}").format(_LIST.format(Markup().join(lines)))

"""The page's control panel: the request and its parts, the room and its pieces, map, view and
downloads."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import torch
from markupsafe import Markup

from sceneprior.apps.retrieval.cad_models import CadModels
from sceneprior.apps.viewer.explorer import HERE, PATH_STEPS, Explorer
from sceneprior.apps.viewer.map import map_picture, mark_style, read_event
from sceneprior.apps.viewer.page import Page
from sceneprior.apps.viewer.requested import line_of_clauses, read_line
from sceneprior.apps.viewer.shown import FORMATS, Folder, Shown, download
from sceneprior.apps.viewer.texts import WORSE, html, room_html, value_of, wishes_html
from sceneprior.apps.viewer.views import VIEWS
from sceneprior.core.errors import InputError
from sceneprior.core.shell import SHELLS, ShellName
from sceneprior.lifted.requests.request import RoomRequest

if TYPE_CHECKING:
    import viser

_STYLE = files("sceneprior.apps.viewer").joinpath("page.css").read_text()
_LOCK, _UNLOCK = "Lock this piece", "Unlock this piece"


def open_page(
    server: "viser.ViserServer",
    source: Explorer | Folder,
    title: str,
    models: CadModels | None = None,
    asked: Mapping[str, Any] | None = None,
    shell: ShellName = "walls",
) -> "Panel":
    """A page with its panel; see `Page` for the arguments."""
    server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(58, 88, 138))
    server.gui.set_panel_label(title)
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(350)
    return Panel(Page(server, source, models, RoomRequest.of(**asked or {}), shell))


class Panel:
    """The controls of a page, with descriptions of the shown room and its wishes."""

    def __init__(self, page: Page):
        self.page, self._gui, source = page, page.server.gui, page.source
        self.line: Any = None
        """The text field of the request; None without one."""
        self._chips: Any = None
        self.seed: Any = None
        self.follows: Any = None
        self._mark: Any = None
        self._origin: Any = None
        self._tries, self._ticks = 0, list[tuple[str, bool]]()
        self._gui.add_html(f"<style>{_STYLE}</style>")
        views = self._gui.add_button_group("", VIEWS)
        views.on_click(lambda e: page.safely(lambda: page.look(value_of(views), e.client)))
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Room"):
            if isinstance(source, Folder):
                self._add_folder(source)
                page.tell = self._said()
            else:
                self._add_rooms(source)
            tasks = {"Undo": page.undo, "Replace by model": page.replace_by_models}
            if self.line is not None:
                tasks = {_LOCK: self.lock, "Complete": self.complete} | tasks
            self._pieces = self._buttons(tasks)
            if isinstance(source, Explorer):
                self._add_choices(source)
            self._room_text = self._gui.add_html("")
        if isinstance(source, Explorer) and source.has_latents:
            if source.map is not None:
                with tabs.add_tab("Map"):
                    self._add_map(source)
            with tabs.add_tab("Path"):
                self._add_path(source)
        with tabs.add_tab("View"):
            self._add_view()
        with tabs.add_tab("Save"):
            self._add_download()
        page.on_show = self._describe
        self._describe()

    def _said(self) -> Callable[[str], None]:
        """A place for an error, below the control that is added before."""
        place = self._gui.add_html("", visible=False)

        def tell(text: str) -> None:
            place.content, place.visible = html(WORSE.format(text)), bool(text)

        return tell

    def _describe(self) -> None:
        """Describe the shown room, and let the controls show its state."""
        shown, source = self.page.shown, self.page.source
        wishes = Markup() if self.line is not None else wishes_html(shown.scene)
        self._room_text.content = html(room_html(shown) + wishes)
        if self.line is not None and isinstance(source, Explorer):
            self.line.value = shown.line
            self._ticks = source.ticks(shown)
            self._chips.options = tuple(
                f"{'✓' if holds else '✗'} {text}  ×" for text, holds in self._ticks
            )
            self._chips.visible = self._asked.visible = bool(self._ticks)
            lock = _UNLOCK if shown.picked in shown.locked else _LOCK
            self._pieces.options = (lock, *self._pieces.options[1:])
        if self._mark is not None and isinstance(source, Explorer) and source.map is not None:
            latent = shown.scene.latent
            z = None if latent is None else torch.from_numpy(latent)
            self._mark.content = mark_style(source.map, z)

    # -- Rooms ---------------------------------------------------------------------------------

    def _add_folder(self, folder: Folder) -> None:
        page, count = self.page, len(folder.scenes)
        self._text(f"{count} rooms. Drag a piece to move it; click it for its size.")
        if count > 1:
            number: Any = self._gui.add_slider("Room", min=1, max=count, step=1, initial_value=1)
            number.on_update(
                lambda _: page.follow(lambda: page.show(folder.room(value_of(number) - 1)))
            )

    def _add_rooms(self, explorer: Explorer) -> None:
        gui, page, asks = self._gui, self.page, explorer.takes_requests
        told = " Describe one and press Enter, or click an example." if asks else ""
        self._text(f"Rooms that this prior draws.{told} Drag a piece to move it.")
        if asks:
            self.line = gui.add_text("", "", multiline=True)
            self.line.on_update(
                lambda _: page.safely(self.typed) if "\n" in self.line.value else None
            )
        page.tell = self._said()
        if asks:
            self._buttons({line: partial(self._ask, line) for line in explorer.examples})
            mark = Markup('<span class="sp-chips"></span>')
            self._asked = self._text(mark + "Asked for; click a part to remove it:")
            self._chips = gui.add_button_group("", ("",))
            self._chips.on_click(lambda _: page.safely(self._remove))
        gui.add_button("New room").on_click(lambda _: page.safely(self.another))

    def _add_choices(self, explorer: Explorer) -> None:
        """What follows a drag, and what New room draws from."""
        gui, page = self._gui, self.page
        if explorer.takes_requests:
            self.follows = gui.add_checkbox(
                "The rest follows", True, hint="Others are placed anew around a dropped piece"
            )
            page.on_drop = self.drop
        with gui.add_folder("Seed", expand_by_default=False):
            if known := explorer.distributions:
                self._origin = gui.add_dropdown("From", known, initial_value=known[0])
                self._origin.on_update(lambda _: page.safely(self.sample))
            self.seed = gui.add_number("Seed", 0, min=0, step=1)
            self.seed.on_update(lambda _: page.safely(self.sample))

    def sample(self) -> None:
        """Show the room of the seed, for the request."""
        source, shown = self.page.source, self._asked_for()
        assert isinstance(source, Explorer), "a prior"
        origin = None if self._origin is None else value_of(self._origin)
        self.page.show(source.sample(value_of(self.seed), origin, shown.request, shown.line))

    def another(self) -> None:
        """Show the room of the next seed, for the request in the field."""
        self.seed.value += 1  # the update triggers `sample`

    def typed(self) -> None:
        """Show a room for the request in the field, after Enter, which a text area keeps."""
        self.line.value = self.line.value.replace("\n", " ").strip()
        self.sample()

    def _asked_for(self) -> Shown:
        """The state with the request as it stands in the field."""
        shown, text = self.page.shown, "" if self.line is None else str(self.line.value).strip()
        if text == shown.line:
            return shown
        return replace(shown, request=read_line(text, shown.request), line=text)

    def _ask(self, line: str) -> None:
        self.line.value = line
        self.sample()

    def _remove(self) -> None:
        """Remove the part of the request whose chip was clicked."""
        row, shown = self._chips.options.index(value_of(self._chips)), self.page.shown
        line = line_of_clauses([text for at, (text, _) in enumerate(self._ticks) if at != row])
        request = read_line(line, shown.request)
        self.page.show(replace(shown, request=request, line=line))

    def lock(self) -> None:
        """Lock the picked object, or unlock it."""
        shown = self.page.shown
        if shown.picked is None:
            raise InputError("No piece is picked; click one in the room first.")
        self.page.show(shown.toggled(shown.picked))

    def complete(self) -> None:
        """Draw everything but the locked objects anew."""
        source, shown = self.page.source, self._asked_for()
        assert isinstance(source, Explorer), "a prior"
        if not shown.locked:
            raise InputError("No piece is locked; drag one, or click one and lock it.")
        self.page.show(source.complete(shown, self._tries))
        self._tries += 1

    def drop(self, row: int, x_m: float, z_m: float) -> None:
        """Move an object, and the others with it if they are to follow."""
        before, source = self.page.shown, self.page.source
        self.page.drop(row, x_m, z_m)
        if self.follows.value and self.page.shown is not before and isinstance(source, Explorer):
            self.page.show(source.follow(self.page.shown, self._tries), remember=False)
            self._tries += 1

    # -- Map and path --------------------------------------------------------------------------

    def _add_map(self, explorer: Explorer) -> None:
        gui, page, latent_map = self._gui, self.page, explorer.map
        assert latent_map is not None, "callers ask first"
        self._mark = gui.add_html("")
        self._map = gui.add_html(map_picture(latent_map))
        sent: Any = gui.add_text("", "")
        tell = self._said()
        self._text(
            f"Drag, or click a dot: each is one of {len(latent_map.rooms)} training rooms. The map "
            "shows the two directions in which their latents differ most "
            f"({latent_map.share:.0%} of the variance); all other coordinates stay."
        )

        def pointed() -> None:
            if (event := read_event(latent_map, str(sent.value))) is not None:
                point, how = event
                self._show_decoded(explorer.at(page.shown, point, how == "click"), how != "drag")

        sent.on_update(lambda _: page.follow(pointed, tell))

    def _show_decoded(self, room: Shown, settled: bool) -> None:
        """Show a room that is decoded from a latent; the request stays for the next one."""
        shown = self.page.shown
        self.page.show(replace(room, request=shown.request, line=shown.line), settled)

    def _add_path(self, explorer: Explorer) -> None:
        gui, page = self._gui, self.page
        self._text("Rooms on the way from one latent to another.")
        hint = f"A training room's id, {HERE}, or paper:7 (seed 7 from paper)"
        start = gui.add_text("From", "paper:1", hint=hint)
        end = gui.add_text("To", "paper:2", hint=hint)
        step: Any = gui.add_slider(
            "Step", min=0, max=PATH_STEPS - 1, step=1, initial_value=0, disabled=True
        )

        def draw() -> None:
            z = explorer.draw_path(page.shown, start.value, end.value)
            if explorer.map is not None:
                self._map.content = map_picture(explorer.map, z)
            step.disabled = False
            step.value = 0
            self._show_decoded(explorer.step(0), True)

        def walk() -> None:
            if explorer.path is not None:
                place = value_of(step)
                self._show_decoded(explorer.step(place), place in (0, PATH_STEPS - 1))

        button = gui.add_button("Draw path")
        tell = self._said()
        button.on_click(lambda _: page.safely(draw, tell))
        step.on_update(lambda _: page.follow(walk, tell))

    # -- View and files ------------------------------------------------------------------------

    def _add_view(self) -> None:
        gui, page = self._gui, self.page
        choice = gui.add_dropdown(
            "Shell", SHELLS, initial_value=page.shell,
            hint="Floor and walls, the floor, or neither; in downloads, too",
        )  # fmt: skip
        self._choice("shell", choice)
        self._choice("names", gui.add_checkbox("Names and sizes", False))
        self._choice("boxes", gui.add_checkbox("Boxes", False))

    def _choice(self, name: str, control: Any) -> None:
        """Let a control choose the value `name` of the page's display."""
        page = self.page

        def chosen() -> None:
            setattr(page, name, value_of(control))
            page.show(page.shown, remember=False)

        control.on_update(lambda _: page.safely(chosen))

    def _add_download(self) -> None:
        form: Any = self._gui.add_dropdown("Format", tuple(FORMATS))
        button = self._gui.add_button("Download")
        tell = self._said()

        def send(client: Any) -> None:
            shown, shell = self.page.shown.scene, self.page.shell
            name, content, notes = download(shown, value_of(form), shell)
            client.send_file_download(name, content, save_immediately=True)
            tell(" ".join(notes))

        button.on_click(lambda event: self.page.safely(lambda: send(event.client), tell))

    def _buttons(self, tasks: dict[str, Callable[[], None]]) -> Any:
        group = self._gui.add_button_group("", tuple(tasks))
        tasks = tasks | {_UNLOCK: self.lock}
        group.on_click(lambda _: self.page.safely(lambda: tasks[value_of(group)]()))
        return group

    def _text(self, text: str) -> Any:
        return self._gui.add_html(html(text))

"""The fields of the panel in which a user requests a room: floor, doors and windows, wishes."""

import contextlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sceneprior.apps.viewer.drawing import HINT, Drawing
from sceneprior.apps.viewer.plan import Plan, plan_of
from sceneprior.apps.viewer.words import html
from sceneprior.core.errors import InputError
from sceneprior.lifted.requests.openings import read_openings
from sceneprior.lifted.requests.shape import read_floor

if TYPE_CHECKING:
    import viser

_FLOOR = "4x3 (metres), or corners: 0,0 5,0 5,3 2,3 2,5 0,5. Empty: any floor."
_OPENINGS = "door, window@north, door@0:1.5 (1.5 m along the wall from corner 0)"
_WANT = "a double bed and two nightstands beside it; or numbers: nightstand: 2, desk: 0"


class RequestFields:
    """Text fields of a request, and the drawing that fills two of them.

    Args:
        asked: The initial request; parts without a text field stay in every request until Clear.
        safely: Runs a browser's task, and shows errors.
        drawn: Called with the plan when a drawing begins, and with None when it ends.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        asked: Mapping[str, Any],
        safely: Callable[[Callable[[], None]], None],
        drawn: Callable[[Plan | None], None],
    ):
        gui = server.gui
        self._safely, self._drawn = safely, drawn
        self.drawing, self._filling = Drawing(server, self._filled), False
        texts, self._rest = _texts_of(asked)
        self.floor: Any = gui.add_text("Floor", texts["floor"], hint=_FLOOR)
        self.openings: Any = gui.add_text("Doors", texts["openings"], hint=_OPENINGS)
        self.want: Any = gui.add_text("Wishes", texts["want"], multiline=True, hint=_WANT)
        self.ceiling: Any = gui.add_text("Ceiling", texts["ceiling_m"], hint="Height in metres")
        self._rest_said = gui.add_html("", visible=False)
        self._kind: Any = gui.add_dropdown("Click puts", ("door", "window"), visible=False)
        self._hint = gui.add_html(html(HINT), visible=False)
        self._draw: Any = gui.add_button("Draw floor and doors", color="gray")
        self._clear: Any = gui.add_button("Clear the request", color="gray")
        self._draw.on_click(lambda _: safely(self._draw_or_end))
        self._clear.on_click(lambda _: safely(self._emptied))
        for field in (self.floor, self.openings):
            field.on_update(lambda _: self._typed())
        self._kind.on_update(lambda _: self._chosen())
        self._say_rest()

    def asked(self) -> dict[str, Any]:
        """The request as arguments of `Prior.sample`; texts that name files are refused.

        Raises:
            InputError: a field cannot be read.
        """
        asked = dict(self._rest)
        if floor := self.floor.value.strip():
            read_floor(floor)  # raises if the text is not a floor, as it might then name a file
            asked["floor"] = floor
        if openings := self.openings.value.strip().strip(","):
            read_openings(openings)
            asked["openings"] = openings
        if want := self.want.value.strip():
            asked["want"] = want
        if ceiling := self.ceiling.value.strip().removesuffix("m"):
            try:
                asked["ceiling_m"] = float(ceiling)
            except ValueError:
                raise InputError(
                    f"The ceiling is '{ceiling[:40]}'; expected its height in metres, such as 2.6."
                ) from None
        return asked

    def end_drawing(self) -> None:
        """End the drawing; the floor's middle becomes the origin, as in requested rooms."""
        if (plan := self.drawing.plan) is not None:
            self.drawing.show(None)
            self._filled(plan.centred())
            self._show_drawing(False)
            self._drawn(None)

    def _draw_or_end(self) -> None:
        if self.drawing.plan is not None:
            self.end_drawing()
            return
        plan = plan_of(self.floor.value, self.openings.value)
        self.drawing.show(plan)
        self._filled(plan)
        self._show_drawing(True)
        self._drawn(plan)

    def _show_drawing(self, drawing: bool) -> None:
        self._kind.visible = self._hint.visible = drawing
        self._draw.label = "End the drawing" if drawing else "Draw floor and doors"

    def _chosen(self) -> None:
        self.drawing.kind = self._kind.value

    def _filled(self, plan: Plan) -> None:
        """Write a plan's texts into the fields."""
        self._filling = True  # setting a field fires its event before the other field is set
        self.floor.value, self.openings.value = plan.floor_text(), plan.openings_text()
        self._filling = False

    def _typed(self) -> None:
        """Redraw the plan from the fields, unless the drawing itself filled them."""
        if self.drawing.plan is None or self._filling:
            return
        # Half-typed text may not be a plan; a request reports the error later.
        with contextlib.suppress(InputError):
            self.drawing.show(plan_of(self.floor.value, self.openings.value))

    def _emptied(self) -> None:
        self.drawing.show(None)
        self._show_drawing(False)
        for field in (self.floor, self.openings, self.want, self.ceiling):
            field.value = ""
        self._rest = {}
        self._say_rest()
        self._drawn(None)

    def _say_rest(self) -> None:
        """Show the names of request parts without a text field."""
        self._rest_said.visible = bool(self._rest)
        names = ", ".join(key.removesuffix("_m") for key in self._rest)
        self._rest_said.content = html(f"The command also requests: {names}.")


def _texts_of(asked: Mapping[str, Any]) -> tuple[dict[str, str], dict[str, Any]]:
    """Split a request into texts for the fields, and parts without a field."""
    texts = dict.fromkeys(("floor", "openings", "want", "ceiling_m"), "")
    rest: dict[str, Any] = {}
    for key, value in asked.items():
        if key == "ceiling_m":
            texts[key] = f"{value:g}"
        elif key in texts and isinstance(value, str):
            texts[key] = value
        elif key == "floor":
            outline = np.asarray(value).tolist()
            texts[key] = Plan(tuple((float(x), float(z)) for x, z in outline)).floor_text()
        elif key == "openings" and all(isinstance(each, str) for each in value):
            texts[key] = ", ".join(value)
        else:
            rest[key] = value
    return texts, rest

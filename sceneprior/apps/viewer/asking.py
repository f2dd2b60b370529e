"""The fields of the panel in which a user requests a room: floor, doors and windows, wishes."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

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
    """Text fields of a request.

    Args:
        asked: The initial request; parts without a text field stay in every request until Clear.
        safely: Runs a browser's task, and shows errors.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        asked: Mapping[str, Any],
        safely: Callable[[Callable[[], None]], None],
    ):
        gui = server.gui
        texts, self._rest = _texts_of(asked)
        self.floor: Any = gui.add_text("Floor", texts["floor"], hint=_FLOOR)
        self.openings: Any = gui.add_text("Doors", texts["openings"], hint=_OPENINGS)
        self.want: Any = gui.add_text("Wishes", texts["want"], multiline=True, hint=_WANT)
        self.ceiling: Any = gui.add_text("Ceiling", texts["ceiling_m"], hint="Height in metres")
        self._rest_said = gui.add_html("", visible=False)
        self._clear: Any = gui.add_button("Clear the request", color="gray")
        self._clear.on_click(lambda _: safely(self._emptied))
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

    def _emptied(self) -> None:
        for field in (self.floor, self.openings, self.want, self.ceiling):
            field.value = ""
        self._rest = {}
        self._say_rest()

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
            corners = np.asarray(value).tolist()
            texts[key] = " ".join(f"{round(x, 3):g},{round(z, 3):g}" for x, z in corners)
        elif key == "openings" and all(isinstance(each, str) for each in value):
            texts[key] = ", ".join(value)
        else:
            rest[key] = value
    return texts, rest

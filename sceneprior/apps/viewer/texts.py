"""Texts of the page's panel, escaped, and values that browsers send to it, checked."""

from typing import Any

import numpy as np
from markupsafe import Markup

from sceneprior.apps.viewer.shown import Shown, name_and_size
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.render.appearance import object_colors

_TEXT = Markup('<div class="sp-text">{}</div>')
_LIST = Markup('<ul class="sp-list">{}</ul>')
_SWATCH = Markup('<span class="sp-swatch" style="background: rgb({}, {}, {})"></span>')
WORSE = Markup('<span class="sp-worse" role="alert">{}</span>')


def value_of(control: Any) -> Any:
    """The value of a control; a client may send any, and one that is not offered is an
    InputError."""
    value, most = control.value, getattr(control, "max", None)
    known = (value,) if most is None else range(control.min, most + 1)
    if value not in (known := getattr(control, "options", known)):
        words = ", ".join(map(str, known)) if len(known) < 12 else f"{known[0]} to {known[-1]}"
        raise InputError(f"'{str(value)[:40]}' is not offered here; choose from {words}.")
    return value


def html(text: str) -> str:
    """Text for the panel, escaped unless it is `Markup`.

    Names from files are shown only by this function, never as Markdown: viser executes HTML in
    Markdown, and reads its images from the server's files.
    """
    return str(_TEXT.format(text))


def room_html(shown: Shown) -> Markup:
    """The shown room: its origin, its floor, and its objects in the colours of their classes, with
    locked objects in bold."""
    scene, lines = shown.scene, []
    for row, (item, color) in enumerate(
        zip(scene.objects, object_colors(scene).tolist(), strict=True)
    ):
        name = Markup("<b>{}</b>" if row in shown.locked else "{}").format(name_and_size(item))
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
            text = f"✓ {wish}" if holds else WORSE.format(f"✗ {wish}: not fulfilled")
            lines.append(Markup("<li>{}</li>").format(text))
    return Markup("<b>Wishes</b>{}").format(_LIST.format(Markup().join(lines)))

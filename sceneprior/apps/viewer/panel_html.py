"""Texts of the panel as HTML: the shown room, its wishes, and a legend of its classes."""

from typing import Any

import numpy as np
from markupsafe import Markup

from sceneprior.apps.viewer.explorer import Shown
from sceneprior.apps.viewer.scene_nodes import name_and_size
from sceneprior.core.scene import Scene
from sceneprior.render.appearance import object_colors

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
    return Markup("<b>{}</b>{}{}").format(shown.origin, _floor_html(scene), _LIST.format(rows))


def _floor_html(scene: Scene) -> Markup:
    """The extents of a room's floor, and its doors and windows; empty if the floor is unknown."""
    if scene.floor_m is None:
        return Markup()
    x, z = np.ptp(scene.floor_m, axis=0)
    parts = [f"{x:.2f} x {z:.2f} m"]
    for kind in ("door", "window"):
        if count := sum(each.kind == kind for each in scene.openings):
            parts.append(f"{count} {kind}{'s' * (count > 1)}")
    return Markup("<br>Floor: {}").format(", ".join(parts))


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
            text = f"✓ {wish}" if holds else error_html(f"✗ {wish}: not fulfilled")
            lines.append(Markup("<li>{}</li>").format(text))
    return Markup("<b>Wishes</b>{}").format(_LIST.format(Markup().join(lines)))


def error_html(sentence: str) -> Markup:
    """The reason why a request cannot be met."""
    return _WORSE.format(sentence)

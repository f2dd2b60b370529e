"""A page of rooms alone, to send: each turns under the mouse, beside its plan."""

from collections.abc import Sequence
from pathlib import Path

from sceneprior.evaluation.page import faces_per_object, render
from sceneprior.evaluation.report_pictures import legend, room_pictures
from sceneprior.files import write_whole
from sceneprior.offscreen import Renderer
from sceneprior.scene import Scene

ROOMS_SHOWN = 24


def write_rooms_page(
    path: Path,
    scenes: Sequence[Scene],
    renderer: Renderer,
    *,
    title: str,
    subtitle: str,
    pictures: Sequence[tuple[str, str]] = (),
) -> None:
    """Write one HTML file of a few MB that needs nothing outside itself.

    Args:
        scenes: The first 24 are shown.
        subtitle: Where they come from.
        pictures: (caption, data URI) above the rooms.
    """
    shown = scenes[:ROOMS_SHOWN]
    most_faces = faces_per_object(shown)
    page = render(
        "rooms.html.jinja",
        title=title,
        subtitle=subtitle,
        pictures=pictures,
        rooms=[room_pictures(scene, renderer, most_faces) for scene in shown],
        legend=legend(shown),
    )
    write_whole(path, page)

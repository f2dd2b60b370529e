"""A page of rooms to send to others: a 3D model and a top-down picture of each room."""

from collections.abc import Sequence
from pathlib import Path

from sceneprior.core.files import write_whole
from sceneprior.core.scene import Scene
from sceneprior.core.shell import ShellName
from sceneprior.evaluation.page import faces_per_object, render
from sceneprior.evaluation.report_pictures import legend, room_pictures

ROOMS_SHOWN = 24


def write_rooms_page(
    path: Path,
    scenes: Sequence[Scene],
    *,
    title: str,
    subtitle: str,
    pictures: Sequence[tuple[str, str]] = (),
    shell: ShellName = "none",
) -> None:
    """Write one self-contained HTML file of a few MB, with `pictures` (caption, data URI) above the
    first rooms. `shell` is that of `room_pictures`."""
    shown = scenes[:ROOMS_SHOWN]
    most_faces = faces_per_object(shown)
    page = render(
        "rooms.html.jinja",
        title=title,
        subtitle=subtitle,
        pictures=pictures,
        rooms=[room_pictures(scene, most_faces, shell) for scene in shown],
        legend=legend(shown),
    )
    write_whole(path, page)

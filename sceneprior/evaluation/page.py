"""Self-contained HTML pages that need no network: templates, pictures and 3D models of rooms, and
the page of rooms to send to others."""

import base64
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from sceneprior import __version__
from sceneprior.core.classes import label_set
from sceneprior.core.files import write_whole
from sceneprior.core.scene import Mesh, Scene
from sceneprior.core.shell import ShellName, shell_of
from sceneprior.core.surfaces import decimate
from sceneprior.render.appearance import png_bytes, quiet_colors
from sceneprior.render.scene_files import scene_to_glb
from sceneprior.render.topdown import (
    corner_view,
    perspective,
    plan_of,
    shows_walls,
    topdown_protocol,
    view_of,
)

FACES_PER_PAGE = 100_000
"""Limit on the faces of all models of a page. A face takes 24 bytes, so a page has a few MB."""
FEWEST_FACES = 200
"""Smallest limit on the faces of one object, used on pages with many objects."""


def render(template: str, **values: Any) -> str:
    """The text of a page from a template of this folder; a variable of the template without a value
    is an error."""
    environment = Environment(
        loader=PackageLoader("sceneprior.evaluation", "."),
        autoescape=True,
        undefined=StrictUndefined,  # a misspelt name is an error, not a blank
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(version=__version__, **values)


def write_page(
    path: Path,
    template: str,
    rooms: Mapping[str, Sequence[Scene]],
    *,
    flat: Sequence[str] = (),
    shell: ShellName = "none",
    **values: Any,
) -> None:
    """Write one self-contained HTML file of a few MB from a template of this folder, with the
    pictures and 3D models of groups of rooms, by the group's name in the template.

    The page loads nothing from a network: the policy in its head forbids it. The groups `flat` have
    pictures alone, and `shell` is that of `room_pictures`.
    """
    script = files("sceneprior.evaluation").joinpath("model_viewer", "model-viewer-umd.min.js")
    shown = [(name, scene) for name, group in rooms.items() for scene in group]
    objects = sum(len(scene.objects) for name, scene in shown if name not in flat)
    most_faces = max(FACES_PER_PAGE // max(objects, 1), FEWEST_FACES)
    drawn: dict[str, list[dict[str, str]]] = {name: [] for name in rooms}
    for name, scene in shown:
        drawn[name].append(room_pictures(scene, 0 if name in flat else most_faces, shell))
    page = render(
        template,
        viewer=Markup(script.read_text("utf-8")),
        legend=_legend([scene for _, scene in shown]),
        **drawn,
        **values,
    )
    write_whole(path, page.encode())


def glb_of(scene: Scene, most_faces: int, shell: ShellName) -> bytes:
    """The room on its floor as a GLB, meshes decimated to about `most_faces` faces.

    With walls (see `shows_walls`), only their faces towards the room, so that none hides it.
    """
    light = []
    for item in scene.objects:
        if item.mesh is not None:
            vertices_m = np.asarray(item.mesh.vertices_m, dtype=np.float64)
            mesh = Mesh(*decimate(vertices_m, np.asarray(item.mesh.faces), most_faces))
            item = replace(item, mesh=mesh, textured=())
        light.append(item)
    floor = {"floor": corner_view([scene]).floor}
    room = shell_of(scene).inner_meshes() if shows_walls(scene, shell) else floor
    return scene_to_glb(replace(scene, objects=tuple(light)), room)


def png_uri(image: Image.Image) -> str:
    """A picture as a PNG in a data URI."""
    return data_uri("image/png", png_bytes(image, optimize=True))


def data_uri(kind: str, content: bytes) -> str:
    """A data URI: a file's content inside a page, with its media type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def room_pictures(scene: Scene, most_faces: int, shell: ShellName) -> dict[str, str]:
    """Draw a scene's plan and corner view, and export its 3D model.

    View and model have walls if `shell` is `walls`, or the room has doors or windows. `most_faces`
    limits the faces of each object's mesh; 0 leaves the model out.

    Returns:
        `name`; `contents`, the objects in words ("double bed, nightstand ×2"); and data URIs:
        `topdown`, the plan from straight above, at half size and the same scale for all rooms;
        `perspective`, the shaded view from above a corner; `glb`, the 3D model that replaces this
        view, or an empty text.
    """
    counts = Counter(item.label.replace("_", " ") for item in scene.objects)
    words = [name if many == 1 else f"{name} ×{many}" for name, many in sorted(counts.items())]
    flat = plan_of(scene, np.zeros(2), topdown_protocol(scene.label_set).window_m)
    flat = flat.resize((256, 256), Image.Resampling.BOX)
    solid = io.BytesIO()
    shaded = Image.fromarray(perspective(scene, view=view_of(scene, (330, 440), shell)))
    shaded.save(solid, format="JPEG", quality=86, optimize=True)
    glb = data_uri("model/gltf-binary", glb_of(scene, most_faces, shell)) if most_faces else ""
    return {
        "name": scene.name,
        "contents": ", ".join(words) or "nothing",
        "topdown": png_uri(flat.quantize(64)),
        "perspective": data_uri("image/jpeg", solid.getvalue()),
        "glb": glb,
    }


def _legend(scenes: Sequence[Scene]) -> list[tuple[str, str]]:
    """(class name, CSS colour) of every class in the scenes, in the label set's order."""
    if not scenes:
        return []
    names = label_set(scenes[0].label_set)
    colors = quiet_colors(names)
    present = {item.label for scene in scenes for item in scene.objects}
    return [
        (name.replace("_", " "), f"#{bytes(color.tolist()).hex()}")
        for name, color in zip(names, colors, strict=True)
        if name in present
    ]


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
    if len(scenes) > ROOMS_SHOWN:
        subtitle += f" · the first {ROOMS_SHOWN} of {len(scenes)} rooms"
    rooms = {"rooms": scenes[:ROOMS_SHOWN]}
    texts: dict[str, Any] = {"title": title, "subtitle": subtitle, "pictures": pictures}
    write_page(path, "rooms.html.jinja", rooms, shell=shell, **texts)

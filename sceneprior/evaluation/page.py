"""Self-contained HTML pages: templates, and interactive 3D models that need no network."""

import base64
from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from sceneprior import __version__
from sceneprior.core.scene import Mesh, Scene
from sceneprior.core.shell import ShellName, shell_of
from sceneprior.core.surfaces import decimate
from sceneprior.render.pictures import png_bytes
from sceneprior.render.scene_files import scene_to_glb
from sceneprior.render.topdown import corner_view, shows_walls

FACES_PER_PAGE = 100_000
"""Limit on the faces of all models of a page. A face takes 24 bytes, so a page has a few MB."""
FEWEST_FACES = 200
"""Smallest limit on the faces of one object, used on pages with many objects."""


def render(template: str, **values: Any) -> bytes:
    """Render a page from a template of this folder; a variable without a value is an error.

    The page loads nothing from a network: the policy in its head forbids it.
    """
    environment = Environment(
        loader=PackageLoader("sceneprior.evaluation", "."),
        autoescape=True,
        undefined=StrictUndefined,  # a misspelt name is an error, not a blank
        trim_blocks=True,
        lstrip_blocks=True,
    )
    script = files("sceneprior.evaluation").joinpath("model_viewer", "model-viewer-umd.min.js")
    viewer = Markup(script.read_text("utf-8"))
    page = environment.get_template(template).render(viewer=viewer, version=__version__, **values)
    return page.encode()


def faces_per_object(scenes: Sequence[Scene]) -> int:
    """Limit on the faces of each object on a page that shows these rooms."""
    objects = sum(len(scene.objects) for scene in scenes)
    return max(FACES_PER_PAGE // max(objects, 1), FEWEST_FACES)


def glb_of(scene: Scene, most_faces: int, shell: ShellName = "none") -> bytes:
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

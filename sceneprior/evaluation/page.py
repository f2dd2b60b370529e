"""Pages in one HTML file: templates, and rooms that turn under the mouse without a network."""

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
from sceneprior.geometry.isosurface import decimate
from sceneprior.pictures import png_bytes
from sceneprior.scene import Mesh, Scene
from sceneprior.scene_files import scene_to_glb
from sceneprior.topdown import corner_view

FACES_PER_PAGE = 100_000
"""Of all rooms of a page together. A face takes 24 bytes there, so a page stays at a few MB."""
FEWEST_FACES = 200
"""Of an object, where there are so many that their share of the page would be smaller."""


def render(template: str, **values: Any) -> bytes:
    """A page made from a template of this folder; a name that the template lacks is an error.

    The page may ask no network for anything: its own head forbids it.
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
    """How many faces an object may have on a page that shows these rooms."""
    objects = sum(len(scene.objects) for scene in scenes)
    return max(FACES_PER_PAGE // max(objects, 1), FEWEST_FACES)


def glb_of(scene: Scene, most_faces: int) -> bytes:
    """The room on its floor as a GLB, objects of about so many faces at most."""
    light = []
    for item in scene.objects:
        if item.mesh is not None:
            vertices_m = np.asarray(item.mesh.vertices_m, dtype=np.float64)
            mesh = Mesh(*decimate(vertices_m, np.asarray(item.mesh.faces), most_faces))
            item = replace(item, mesh=mesh)
        light.append(item)
    return scene_to_glb(replace(scene, objects=tuple(light)), corner_view([scene]).floor)


def png_uri(image: Image.Image) -> str:
    """A picture as a PNG in a data URI."""
    return data_uri("image/png", png_bytes(image, optimize=True))


def data_uri(kind: str, content: bytes) -> str:
    """What a page may hold in place of a file, of this media type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"

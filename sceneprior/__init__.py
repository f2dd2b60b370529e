"""Learns 3D scene priors from posed 2D instance masks.

`load` opens a trained prior, `load_scene` a room; `save` writes a room, `picture` and `show` draw
it. Each is imported when it is first asked for.
"""

import os
import sys
from typing import TYPE_CHECKING, Any

# Torch's threads that wait for each other by spinning, as OpenMP has them by default, wait for many
# times a step where another program has the core of one. Read when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    from sceneprior.apps.api import Prior, load
    from sceneprior.apps.sample import load_request
    from sceneprior.core.scene import Scene
    from sceneprior.render.scene_files import load_scene, save
    from sceneprior.render.topdown import perspective as picture
    from sceneprior.render.topdown import show

__version__ = "0.1.0"
__all__ = [
    "Prior", "Scene", "__version__", "load", "load_request", "load_scene", "picture", "save",
    "show",
]  # fmt: skip

_HOMES = {
    "Prior": "sceneprior.apps.api:Prior",
    "Scene": "sceneprior.core.scene:Scene",
    "load": "sceneprior.apps.api:load",
    "load_request": "sceneprior.apps.sample:load_request",
    "load_scene": "sceneprior.render.scene_files:load_scene",
    "picture": "sceneprior.render.topdown:perspective",
    "save": "sceneprior.render.scene_files:save",
    "show": "sceneprior.render.topdown:show",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'sceneprior' has no attribute '{name}'")
    import importlib

    module, _, function = _HOMES[name].partition(":")
    return getattr(importlib.import_module(module), function)


def _draw_scenes_in_notebooks() -> None:
    """Let a notebook display the picture of a scene that is the last line of a cell."""
    notebook = sys.modules.get("IPython")
    shell = notebook and notebook.get_ipython()
    if shell is not None:
        formatter = shell.display_formatter.formatters["text/html"]
        formatter.for_type_by_name("sceneprior.core.scene", "Scene", _html_of)


def _html_of(scene: "Scene") -> str:
    from sceneprior.render.topdown import html_of

    return html_of(scene)


_draw_scenes_in_notebooks()


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})

"""Learns 3D scene priors from posed 2D instance masks.

`load` opens a trained prior, `load_scene` a room; both are imported when they are first asked for.
"""

import os
from typing import TYPE_CHECKING, Any

# Torch's threads that wait for each other by spinning, as OpenMP has them by default, wait for many
# times a step where another program has the core of one. Read when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    from sceneprior.apps.api import Prior, load
    from sceneprior.apps.requests import load_request
    from sceneprior.core.scene import Scene
    from sceneprior.render.scene_files import load_scene

__version__ = "0.1.0"
__all__ = ["Prior", "Scene", "__version__", "load", "load_request", "load_scene"]

_HOMES = {
    "Prior": "sceneprior.apps.api",
    "Scene": "sceneprior.core.scene",
    "load": "sceneprior.apps.api",
    "load_request": "sceneprior.apps.requests",
    "load_scene": "sceneprior.render.scene_files",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'sceneprior' has no attribute '{name}'")
    import importlib

    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})

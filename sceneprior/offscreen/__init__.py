"""Draws instance ids and shaded pictures of meshes without a screen.

The only user of pyrender. Where the machine has no GL library, a z-buffer of our own
(offscreen/zbuffer.py) draws the same ids.
"""

import functools
import os
import sys

from sceneprior.errors import InputError
from sceneprior.offscreen.gl import NoGLError, open_pyrender
from sceneprior.offscreen.renderer import (
    Camera,
    Orthographic,
    Pinhole,
    Renderer,
    SoftwareRenderer,
)

__all__ = ["Camera", "Orthographic", "Pinhole", "Renderer", "SoftwareRenderer", "open_renderer"]

KINDS = ("auto", "pyrender", "software")
ENVIRONMENT_VARIABLE = "SCENEPRIOR_RENDERER"
"""Set to `pyrender` or `software`, it decides what `auto` means."""
APT_LINE = "apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri"


def open_renderer(kind: str = "auto") -> Renderer:
    """Open the renderer of this process.

    Args:
        kind: `pyrender` (GPU or software GL), `software` (our z-buffer), or `auto`: pyrender where
            GL works, else software with one line of notice. The environment variable
            SCENEPRIOR_RENDERER overrides `auto`.

    Raises:
        InputError: no such kind, or pyrender was asked for and GL does not work here.
    """
    if kind == "auto":
        kind = os.environ.get(ENVIRONMENT_VARIABLE) or "auto"
    if kind not in KINDS:
        raise InputError(f"No renderer is called '{kind}'; there are {', '.join(KINDS)}.")
    if kind == "software":
        return SoftwareRenderer()
    try:
        return open_pyrender()
    except NoGLError as error:
        if kind == "pyrender":
            raise InputError(
                f"pyrender cannot draw here: {error}. Install GL with `{APT_LINE}`, "
                "or choose `--renderer software`."
            ) from None
        _notice(str(error))
        return SoftwareRenderer()


@functools.cache
def _notice(reason: str) -> None:
    print(
        f"Note: drawing with the software z-buffer, because {reason} (`{APT_LINE}` would let "
        "pyrender draw).",
        file=sys.stderr,
    )

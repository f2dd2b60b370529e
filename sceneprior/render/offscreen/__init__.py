"""Off-screen rendering of instance ids and shaded pictures of meshes.

This is the only user of pyrender. Without a GL library, the package's z-buffer
(render/offscreen/zbuffer.py) draws the same ids.
"""

import functools
import os
import sys

from sceneprior.core.errors import InputError
from sceneprior.render.offscreen.gl import NoGLError, open_pyrender
from sceneprior.render.offscreen.renderer import Renderer, SoftwareRenderer

__all__ = ["Renderer", "SoftwareRenderer", "open_renderer"]

KINDS = ("auto", "pyrender", "software")
ENVIRONMENT_VARIABLE = "SCENEPRIOR_RENDERER"
"""Environment variable that sets the meaning of `auto` to `pyrender` or `software`."""
APT_LINE = "apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri"


def open_renderer(kind: str = "auto") -> Renderer:
    """Open the renderer of this process.

    `kind` is `pyrender` (GPU or software GL), `software` (the package's z-buffer), or `auto`, which
    opens pyrender if GL works, and otherwise prints a note and opens the z-buffer. The environment
    variable SCENEPRIOR_RENDERER overrides `auto`.
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

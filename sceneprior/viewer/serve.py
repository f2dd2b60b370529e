"""Serve the page until Ctrl-C."""

import threading
from collections.abc import Callable
from pathlib import Path

import torch

from sceneprior.api import load
from sceneprior.generation.cad_models import default_cache, open_models
from sceneprior.scene_files import load_scene_folder
from sceneprior.viewer.explorer import Explorer, Folder
from sceneprior.viewer.page import Page
from sceneprior.viewer.server import serving


def serve(
    where: str,
    host: str,
    port: int,
    models: Path | None,
    cache: Path | None,
    checkpoint: str,
    say: Callable[[str], None],
) -> None:
    """Serve a run, or a folder of scenes, until Ctrl-C; `say` prints a line.

    Raises:
        InputError: there is nothing to show, or its CAD models cannot be read.
    """
    # One room at a time is too little work to share: several threads spend it on waiting.
    torch.set_num_threads(1)
    stop = threading.Event()
    try:
        source = open_source(where, checkpoint)
        bank = None
        if models is not None:
            bank = open_models(models, source.label_set, cache or default_cache())
        with serving(host, port) as server:
            Page(server, source, Path(where).name, bank)
            say(f"Open http://localhost:{port} in a browser. Ctrl-C ends it.")
            if isinstance(source, Explorer):
                threading.Thread(target=source.find_meshes, args=(stop,)).start()
            stop.wait()
    except KeyboardInterrupt:
        say("\nStopped: the page is closed.")
    finally:
        stop.set()


def open_source(where: str, checkpoint: str = "final") -> Explorer | Folder:
    """What a text names: a folder that is no run is a folder of scenes, of any method.

    Raises:
        InputError: it is neither, or is damaged.
    """
    folder = Path(where)
    if folder.is_dir() and not (folder / "config.yaml").is_file():
        return Folder(load_scene_folder(folder))
    return Explorer(load(where, checkpoint))

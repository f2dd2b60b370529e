"""Serve the viewer's page until Ctrl-C."""

import threading
from collections.abc import Callable
from pathlib import Path

import torch

from sceneprior.apps.api import load
from sceneprior.apps.retrieval.cad_models import open_models
from sceneprior.apps.viewer.explorer import Explorer, Folder
from sceneprior.apps.viewer.page import Page
from sceneprior.apps.viewer.server import serving
from sceneprior.render.scene_files import load_scene_folder


def serve(
    where: str,
    host: str,
    port: int,
    models: Path | None,
    cache: Path | None,
    say: Callable[[str], None],
) -> None:
    """Serve a run, or a folder of scenes, until Ctrl-C; `say` prints a line."""
    # One room at a time is too little work for several threads.
    torch.set_num_threads(1)
    stop = threading.Event()
    try:
        source = open_source(where)
        bank = None if models is None else open_models(models, source.label_set, cache)
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


def open_source(where: str) -> Explorer | Folder:
    """Open a run or prior, or, if the path is a folder without a run, a folder of scenes."""
    folder = Path(where)
    if folder.is_dir() and not (folder / "config.yaml").is_file():
        return Folder(load_scene_folder(folder))
    return Explorer(load(where))

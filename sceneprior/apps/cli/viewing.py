"""The command view; it imports its dependencies when called."""

import threading
from pathlib import Path
from typing import Annotated, Any

import typer

from sceneprior.apps.cli.options import (
    MODELS_HELP,
    OWN_HELP,
    CacheOption,
    ShellOption,
    checked_shell,
    with_request,
)


@with_request
def view(
    where: Annotated[
        str, typer.Argument(metavar="RUN_OR_SCENES", help="A run, or a folder of scenes.")
    ],
    models: Annotated[
        Path | None,
        typer.Option(help=f"Models that the page may show: {MODELS_HELP} {OWN_HELP}"),
    ] = None,
    asked: Any = None,
    shell: ShellOption = None,
    host: Annotated[
        str, typer.Option(help="Address to serve on; 0.0.0.0 opens the page to your network.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to serve on.")] = 8080,
    cache: CacheOption = None,
) -> None:
    """View rooms in the browser, request new ones, and explore the latent space of a run.

    Ctrl-C ends it. The first room fulfils the request given by the options, and is shown with walls
    unless --shell says otherwise.
    """
    from sceneprior.apps.viewer.server import check_can_serve, serving
    from sceneprior.core.errors import InputError

    check_can_serve(host, port)  # before seconds are spent on loading
    drawn = checked_shell(shell or "walls")
    import torch

    from sceneprior.apps.api import load
    from sceneprior.apps.requests import with_floor_of_file
    from sceneprior.apps.retrieval.cad_models import open_models
    from sceneprior.apps.viewer.explorer import Explorer, Folder
    from sceneprior.apps.viewer.panel import open_page
    from sceneprior.render.scene_files import load_scene_folder

    # One room at a time is too little work for several threads.
    torch.set_num_threads(1)
    folder, stop = Path(where), threading.Event()
    is_folder = folder.is_dir() and not (folder / "config.yaml").is_file()
    try:
        if asked and is_folder:
            raise InputError(
                f"{where} holds scenes, which are shown as they are; a request needs a prior."
            )
        source = Folder(load_scene_folder(folder)) if is_folder else Explorer(load(where))
        bank = None if models is None else open_models(models, source.label_set, cache)
        with serving(host, port) as server:
            open_page(server, source, folder.name, bank, with_floor_of_file(asked), drawn)
            typer.echo(f"Open http://localhost:{port} in a browser. Ctrl-C ends it.")
            if isinstance(source, Explorer):
                threading.Thread(target=source.find_meshes, args=(stop,)).start()
            stop.wait()
    except KeyboardInterrupt:
        typer.echo("\nStopped: the page is closed.")
    finally:
        stop.set()

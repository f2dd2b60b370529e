"""The command view; it imports its dependencies when called."""

from pathlib import Path
from typing import Annotated

import typer


def view(
    where: Annotated[
        str, typer.Argument(metavar="RUN_OR_SCENES", help="A run, or a folder of scenes.")
    ],
    models: Annotated[
        Path | None,
        typer.Option(help="CAD models to swap in: 3D-FUTURE-model, a folder like it, or shards."),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Who may open the page: 0.0.0.0 is anyone in your network.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535)] = 8080,
    cache: Annotated[
        Path | None,
        typer.Option(help="Folder for the models' points (default: ~/.cache/sceneprior)."),
    ] = None,
) -> None:
    """View rooms in the browser, and explore the latent space of a run; Ctrl-C ends it."""
    from sceneprior.apps.viewer.server import check_can_serve

    check_can_serve(host, port)  # before seconds are spent on loading
    from sceneprior.apps.viewer.serve import serve

    serve(where, host, port, models, cache, typer.echo)

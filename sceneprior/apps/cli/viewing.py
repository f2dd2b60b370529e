"""The command view; it imports its dependencies when called."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.apps.cli.options import MODELS_HELP, CacheOption


def view(
    where: Annotated[
        str, typer.Argument(metavar="RUN_OR_SCENES", help="A run, or a folder of scenes.")
    ],
    models: Annotated[
        Path | None,
        typer.Option(help=f"CAD models to replace objects with: {MODELS_HELP}"),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to serve on; 0.0.0.0 opens the page to your network.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to serve on.")] = 8080,
    cache: CacheOption = None,
) -> None:
    """View rooms in the browser, and explore the latent space of a run; Ctrl-C ends it."""
    from sceneprior.apps.viewer.server import check_can_serve

    check_can_serve(host, port)  # before seconds are spent on loading
    from sceneprior.apps.viewer.serve import serve

    serve(where, host, port, models, cache, typer.echo)

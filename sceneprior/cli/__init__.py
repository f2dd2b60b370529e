"""The `sceneprior` command: verbs mounted, and every failure one sentence."""

import os
import sys
from typing import Annotated

import typer

from data_prep.cli import add_commands
from sceneprior import __version__
from sceneprior.cli import comparing, generating, reconstruction, retrieval, training
from sceneprior.cli import evaluating as judging
from sceneprior.errors import InputError

app = typer.Typer(
    name="sceneprior",
    help="Learn priors of furnished rooms from posed instance masks, and use them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
add_commands(app)
for verbs in (training, generating, retrieval, reconstruction, judging, comparing):
    verbs.add_commands(app)


def _show_version(wanted: bool | None) -> None:
    if wanted:
        typer.echo(f"sceneprior {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool | None,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Say it."),
    ] = None,
) -> None:
    pass


def main() -> None:
    """Run the command; whatever is wrong with the input is one sentence and exit status 2."""
    try:
        app()
    except InputError as error:
        typer.echo(f"Error: {error}", err=True)
        sys.exit(2)
    except FloatingPointError as error:
        typer.echo(f"Error: {error}", err=True)
        sys.exit(2)
    except Exception as error:
        if os.environ.get("SCENEPRIOR_DEBUG"):
            raise
        typer.echo(
            f"Error: {type(error).__name__}: {error}\nThis should not happen. Run again with "
            "SCENEPRIOR_DEBUG=1 for the traceback, and please report it.",
            err=True,
        )
        sys.exit(1)

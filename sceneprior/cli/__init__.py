"""The `sceneprior` command: all its subcommands, and every failure as one sentence.

A command's module imports what it needs only when the command is called, so that `--help` is fast.
"""

import os
import sys
from typing import Annotated

import typer

from data_prep.cli import add_commands
from sceneprior import __version__
from sceneprior.cli import (
    evaluating,
    experiments,
    generating,
    reconstruction,
    sharing,
    training,
    viewing,
)
from sceneprior.errors import InputError

app = typer.Typer(
    name="sceneprior",
    help="Learn priors of furnished rooms from posed instance masks, and use them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
add_commands(app)
for command in (
    training.fit, training.report,
    generating.synthesize, generating.interpolate, generating.complete, generating.retrieve,
    reconstruction.reconstruct, reconstruction.eval_svr,
    sharing.pack, sharing.priors, sharing.export,
    evaluating.eval_fid,
    experiments.compare, experiments.demo, viewing.view,
):  # fmt: skip
    app.command()(command)


def _show_version(wanted: bool | None) -> None:
    if wanted:
        typer.echo(f"sceneprior {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool | None,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Print the version and exit."
        ),
    ] = None,
) -> None:
    pass


def main() -> None:
    """Run the command; whatever is wrong with the input is one sentence and exit status 2."""
    try:
        app()
    except (InputError, FloatingPointError) as error:
        typer.echo(f"Error: {error}", err=True)
        sys.exit(2)
    except SystemExit as ended:
        # Typer ends a command that Ctrl-C stopped with status 130, without a word.
        if ended.__context__ and isinstance(ended.__context__.__cause__, KeyboardInterrupt):
            typer.echo("Stopped by Ctrl-C. Every file that was written is whole.", err=True)
        raise
    except Exception as error:
        if os.environ.get("SCENEPRIOR_DEBUG"):
            raise
        typer.echo(
            f"Error: {type(error).__name__}: {error}\nThis should not happen. Run again with "
            "SCENEPRIOR_DEBUG=1 for the traceback, and please report it.",
            err=True,
        )
        sys.exit(1)

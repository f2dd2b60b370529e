"""The Typer app: all commands of `sceneprior`, and its global options.

Each command imports its dependencies when it is called, so that `--help` is fast.
"""

from typing import Annotated

import typer

from data_prep.cli import add_commands
from sceneprior import __version__
from sceneprior.apps.cli import evaluation, rooms, runs
from sceneprior.apps.cli.options import with_workers

app = typer.Typer(
    name="sceneprior",
    help="Learn priors of furnished rooms from posed instance masks, and use them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
add_commands(app, with_workers)
for command in (
    with_workers(runs.fit), evaluation.report,
    with_workers(rooms.synthesize), rooms.interpolate, with_workers(rooms.complete),
    with_workers(rooms.retrieve),
    with_workers(rooms.reconstruct), with_workers(evaluation.eval_svr),
    runs.pack, runs.priors, with_workers(runs.export),
    with_workers(evaluation.evaluate), with_workers(evaluation.eval_fid),
    runs.compare, runs.demo, rooms.view,
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

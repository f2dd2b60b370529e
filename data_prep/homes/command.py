"""The command `sceneprior make-homes`."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.core.seeds import LARGEST_SEED


def make_homes_command(
    out: Annotated[Path, typer.Argument(help="A new folder for the homes.")],
    rooms: Annotated[
        int, typer.Option(help="How many rooms; seven in ten are train, one val, two test.")
    ] = 400,
    room_type: Annotated[str, typer.Option(help="bedroom or living.")] = "bedroom",
    seed: Annotated[
        int, typer.Option(min=0, max=LARGEST_SEED, help="The same seed writes the same bytes.")
    ] = 0,
) -> None:
    """Make furnished homes in 3D-FRONT's on-disk format."""
    from data_prep.homes.make import make_homes

    make_homes(out, rooms, room_type, seed)
    typer.echo(f"Wrote {rooms} {room_type} rooms to {out}")

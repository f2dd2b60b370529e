"""Readers of data sets and captures: each makes the views of rooms from its files."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneprior.core.errors import InputError

if TYPE_CHECKING:
    from data_prep.readers.reader import Reader

DATA_SETS = ("blenderproc", "hypersim", "structured3d", "scannetpp")
"""Data sets of `prep-dataset`."""


def open_reader(name: str, folder: Path, recipe: str | None = None, **settings: Any) -> "Reader":
    """Reader of one of `DATA_SETS`.

    `recipe` selects rooms and classes of 3D-FRONT (None: bedroom); `settings` are fields of
    `Reader`.
    """
    # Imported here, because the modules of this package import the package itself.
    from data_prep.front.recipe import load_recipe
    from data_prep.readers.blenderproc import BlenderProc
    from data_prep.readers.hypersim import Hypersim
    from data_prep.readers.scannetpp import ScanNetPP
    from data_prep.readers.structured3d import Structured3D

    if not folder.is_dir():
        raise InputError(f"No folder at {folder}; expected the scenes of {name}.")
    if name not in DATA_SETS:
        raise InputError(f"No data set is called '{name}'; choose from {', '.join(DATA_SETS)}.")
    if name == BlenderProc.name:
        settings["recipe"] = load_recipe(recipe or "bedroom")
    elif recipe is not None:
        raise InputError(
            f"--recipe selects rooms of 3D-FRONT, so it is not for {name}; leave it out."
        )
    classes: tuple[type[Reader], ...] = (BlenderProc, Hypersim, Structured3D, ScanNetPP)
    reader = {each.name: each for each in classes}[name](folder, **settings)
    if not reader.scenes():
        raise InputError(f"{folder} holds no scene of {name}; docs/public_data.md shows the files.")
    return reader

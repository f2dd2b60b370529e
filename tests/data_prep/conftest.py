"""Fixtures of the data_prep tests."""

from pathlib import Path

import numpy as np
import pytest
import typer
from front_files import FrontFolder
from typer.testing import CliRunner

from data_prep.cli import add_commands


@pytest.fixture
def front(tmp_path: Path) -> FrontFolder:
    """A folder with four models and no house yet."""
    folder = FrontFolder(tmp_path / "data")
    folder.model("bed", "King-size Bed", (1.8, 1.0, 2.0))
    folder.model("stand", "Nightstand", (0.5, 0.6, 0.4))
    folder.model("lamp", "Floor Lamp", (0.3, 1.5, 0.3))
    folder.model("pendant", "Pendant Lamp", (0.4, 0.5, 0.4))
    return folder


@pytest.fixture
def cli():
    """Runs a command of data_prep."""
    app = typer.Typer()
    add_commands(app)
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture
def numbers() -> np.random.Generator:
    return np.random.default_rng(0)

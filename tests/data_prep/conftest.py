"""Fixtures of the data_prep tests."""

from pathlib import Path

import numpy as np
import pytest
import typer
from front_files import FrontFolder, four_models
from typer.testing import CliRunner

from data_prep.cli import add_commands
from sceneprior.apps.cli.options import with_workers


@pytest.fixture
def front(tmp_path: Path) -> FrontFolder:
    """A folder with four models and no house yet."""
    return four_models(tmp_path / "data")


@pytest.fixture
def cli():
    """Runs a command of data_prep."""
    app = typer.Typer()
    add_commands(app, with_workers)
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture
def numbers() -> np.random.Generator:
    return np.random.default_rng(0)

"""Fixtures of the data_prep tests."""

from pathlib import Path

import numpy as np
import pytest
from front_files import FrontFolder


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
def numbers() -> np.random.Generator:
    return np.random.default_rng(0)

"""What every test may use: toy rooms on disk, and a number generator."""

from pathlib import Path

import numpy as np
import pytest
import torch
from toy_rooms import write_toy_shards


@pytest.fixture(scope="session")
def toy_shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """12 training and 4 test rooms of boxes, 8 views each. Tests read it and change nothing."""
    folder = tmp_path_factory.mktemp("toy") / "shards"
    write_toy_shards(folder)
    return folder


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def torch_rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)

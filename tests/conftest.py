"""What every test may use: toy rooms on disk, and a number generator."""

import contextlib
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from tiny_runs import tiny_config
from toy_rooms import write_toy_shards

# Toy tensors gain nothing from a second thread, and wait for it where cores are shared: thirty
# times as long. Numba's OpenMP layer would set torch's number of threads back to all cores.
torch.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_THREADING_LAYER", "workqueue")  # in processes that tests start
numba.config.THREADING_LAYER = os.environ["NUMBA_THREADING_LAYER"]


@pytest.fixture(scope="session")
def toy_shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """12 training and 4 test rooms of boxes, 8 views each. Tests read it and change nothing."""
    folder = tmp_path_factory.mktemp("toy") / "shards"
    write_toy_shards(folder)
    return folder


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen]]:
    """Starts a command in a session of its own, ended with all its children after the test.

    It answers Ctrl-C even where this suite runs in the background, ignoring SIGINT, which children
    inherit; `background=True` starts it as a shell does there.
    """
    begun = []

    def start(command, background: bool = False, **options) -> subprocess.Popen:
        answer = signal.SIG_IGN if background else signal.SIG_DFL
        process = subprocess.Popen(
            command,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, answer),
            **options,
        )
        begun.append(process)
        return process

    yield start
    for process in begun:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def torch_rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def toy_run(toy_shards: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both stages trained on the toy rooms for a few epochs. Tests read it and change nothing."""
    from sceneprior.training.fit import fit

    run = tmp_path_factory.mktemp("toy") / "run"
    fit(tiny_config(toy_shards, layout__epochs=20), run, trainer_options={"accelerator": "cpu"})
    return run

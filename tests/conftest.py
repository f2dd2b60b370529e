"""Fixtures of all tests: toy rooms on disk, and a generator of random numbers."""

import contextlib
import fcntl
import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

# Some are imported only to come before our modules: whatever these import first, jaxtyping's hook
# has compiled from source, since it looks for .pyc files of a name of its own (2,600 modules).
import beartype  # noqa: F401
import compiled  # noqa: F401 (before our modules, whose kernels it keeps from the hook)
import lightning  # noqa: F401
import numpy as np
import pydantic  # noqa: F401
import pytest
import scipy.stats  # noqa: F401
import sklearn.linear_model  # noqa: F401
import torch
from browser import browser  # noqa: F401 (a fixture)
from golden_values import TAKE_RUNS
from kept_runs import LIFTED, add_lifted, take_lifted, write_kept_run
from threadpoolctl import threadpool_limits
from tiny_runs import tiny_config, tiny_sampler_config
from toy_rooms import write_toy_shards

from sceneprior.core.views import images_of_split
from sceneprior.render.offscreen import Renderer, SoftwareRenderer

# Toy tensors gain nothing from a second thread, and wait for it where cores are shared: thirty
# times as long.
torch.set_num_threads(1)
threadpool_limits(1)  # of BLAS, which was loaded with as many as there are cores
os.environ.setdefault("OMP_NUM_THREADS", "1")  # in processes that tests start


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Makes a folder once for all processes of a test run: the first makes it, others wait."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # which the workers share

    def made_once(name: str, make: Callable[[Path], None]) -> Path:
        folder, done = base / "shared" / name, base / "shared" / f"{name}.done"
        folder.parent.mkdir(exist_ok=True)
        with (base / "shared" / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)  # of a worker that failed
                make(folder)
                done.touch()
        return folder

    return made_once


@pytest.fixture(scope="session")
def toy_shards(made_once: Callable[..., Path]) -> Path:
    """12 training and 4 test rooms of boxes, 8 views each, and what was lifted from their masks.
    Tests read it and change nothing."""

    def make(folder: Path) -> None:
        write_toy_shards(folder)
        if LIFTED.exists():
            add_lifted(folder)

    return made_once("shards", make)


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen]]:
    """Starts a command in a session of its own, ended with all its children after the test.

    It answers Ctrl-C and a closed terminal even where this suite runs in the background or under
    nohup, ignoring SIGINT or SIGHUP, which children inherit; `background=True` starts it as a shell
    does there.
    """
    begun = []

    def start(command, background: bool = False, **options) -> subprocess.Popen:
        def begin() -> None:
            signal.signal(signal.SIGINT, signal.SIG_IGN if background else signal.SIG_DFL)
            signal.signal(signal.SIGHUP, signal.SIG_DFL)

        process = subprocess.Popen(command, start_new_session=True, preexec_fn=begin, **options)
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
def toy_run(toy_shards: Path, made_once: Callable[..., Path]) -> Path:
    """A run with both stages, trained on the toy rooms for a few epochs. Tests only read it."""
    config = tiny_config(toy_shards, layout__epochs=20)
    return made_once("run", lambda run: write_kept_run("paper", config, run))


@pytest.fixture(scope="session")
def trained(toy_run: Path):
    """The toy run, ready for use. Tests change nothing of it."""
    from sceneprior.apps.api import load

    return load(toy_run).with_latents


@pytest.fixture(scope="session")
def images(toy_shards: Path):
    """A view of each test room of the toy shards."""
    return images_of_split(toy_shards, "test", 0)[0]


@pytest.fixture(scope="session")
def renderer() -> Renderer:
    """The renderer that every machine has."""
    return SoftwareRenderer()


@pytest.fixture(scope="session")
def sampler_run(toy_shards: Path, made_once: Callable[..., Path]) -> Path:
    """A prior of furniture in parts and its sampler, hardly trained. Tests read it only."""

    def make(run: Path) -> None:
        write_kept_run("sampler", tiny_sampler_config(toy_shards), run)
        if TAKE_RUNS:
            take_lifted(toy_shards)

    return made_once("sampled", make)


@pytest.fixture
def few_attempts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samplers give up on a room early: an untrained one finds places for its furniture late."""
    from sceneprior.lifted.drawing import draw

    few = draw.PLAIN._replace(attempts=6, attempts_per_plan=2, whole=5)
    monkeypatch.setattr(draw, "PLAIN", few)

"""Training under a clock: `fit` itself, a few epochs of a paper-sized run on made homes."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import Callback

from data_prep.engine.build import Job, build_shards
from data_prep.front.recipe import load_recipe
from data_prep.front.source import FrontSource
from data_prep.homes.make import make_homes
from sceneprior.config import load_config
from sceneprior.settings import find_config
from sceneprior.training.fit import fit
from sceneprior.training.method import RunConfig
from sceneprior.training.monitor import Evaluate

CONFIG = "bedroom.yaml"
"""The paper's settings for bedrooms."""


def made_shards(folder: Path, rooms: int, workers: int) -> Path:
    """View shards of so many made bedrooms, seven in ten of them for training."""
    shards, homes = folder / "shards", folder / "homes"
    if not (shards / "index.json").is_file():  # the last thing written
        if not homes.is_dir():
            make_homes(homes, rooms, "bedroom", seed=0)
        front, future = homes / "3D-FRONT", homes / "3D-FUTURE-model"
        splits = homes / "splits" / "bedroom.csv"
        source = FrontSource(front, future, load_recipe("bedroom"), splits)
        build_shards(Job(source, shards, workers, renderer="software"))
    return shards


def paper_run(shards: Path, epochs: int, *changes: str) -> RunConfig:
    """The paper's run on other shards, with both stages cut to a few epochs.

    What it generates is evaluated at each stage's end, or never where nothing evaluates.
    """
    short = (f"layout.epochs={epochs}", f"shape.epochs={epochs}", "samples.every=1000")
    return load_config(str(find_config(CONFIG)), (f"data.shards={shards}", *short, *changes))


@dataclass
class StageTimes:
    """What the clock saw of a stage."""

    rooms: int = 0
    """Rows an epoch, turned copies included, of all processes."""
    network_bytes: int = 0
    latent_bytes: int = 0
    """Of gradients, which several processes add up at each step."""
    starts_s: list[float] = field(default_factory=list)
    """Of epochs, by the clock; and the CPU seconds that the process had taken by then."""
    starts_cpu_s: list[float] = field(default_factory=list)
    steps_s: list[list[float]] = field(default_factory=list)
    """By epoch."""
    peak_mib: float = 0.0
    """The most that tensors took on the GPU; 0 on a CPU."""
    loss: float = 0.0
    """Of the last epoch."""

    @property
    def first_epoch_s(self) -> float:
        return self.starts_s[1] - self.starts_s[0]

    @property
    def epoch_s(self) -> float:
        """Median without the first, which compiles and reads images, and without the last, at whose
        end what is generated is evaluated."""
        return _between(self.starts_s)

    @property
    def epoch_cpu_s(self) -> float:
        """CPU seconds of this process in such an epoch, loader processes aside."""
        return _between(self.starts_cpu_s)

    @property
    def step_s(self) -> float:
        """Median of the same epochs: loss, backward and update, without waiting for data."""
        return statistics.median(step for epoch in self.steps_s[1:-1] for step in epoch)

    def figures(self) -> dict[str, float]:
        """The figures of a table's row."""
        waiting = self.epoch_s - self.step_s * len(self.steps_s[1])
        return {
            "step_s": self.step_s,
            "epoch_s": self.epoch_s,
            "between_steps_s": waiting,
            "first_epoch_s": self.first_epoch_s,
            "rooms_per_s": self.rooms / self.epoch_s,
            "peak_mib": self.peak_mib,
            "loss": self.loss,
        }


StageEnded = Callable[[str, StageTimes], None]


class Clock(Callback):
    """Times every step and epoch of each stage; of several processes, each its own."""

    def __init__(self, matmul: str, ended: StageEnded) -> None:
        self.matmul, self.ended = matmul, ended
        self.stages: dict[str, StageTimes] = {}
        self._began = 0.0

    def on_train_start(self, trainer, pl_module) -> None:
        torch.set_float32_matmul_precision(self.matmul)  # after `fit`, which sets "high"
        trained = {n: p.nbytes for n, p in pl_module.named_parameters() if p.requires_grad}
        latents = sum(size for name, size in trained.items() if name.startswith("latents."))
        self._now = StageTimes(len(pl_module.rooms), sum(trained.values()) - latents, latents)
        self._name = Path(trainer.default_root_dir).name
        self.stages[self._name] = self._now
        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()

    def on_train_epoch_start(self, trainer, pl_module) -> None:
        self._now.starts_s.append(_now_s())
        self._now.starts_cpu_s.append(time.process_time())
        self._now.steps_s.append([])

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:
        self._began = _now_s()

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        self._now.steps_s[-1].append(_now_s() - self._began)

    def on_train_end(self, trainer, pl_module) -> None:
        self._now.loss = float(trainer.callback_metrics["train/loss"])
        if torch.cuda.is_available():
            self._now.peak_mib = torch.cuda.max_memory_allocated() / 2**20
        self.ended(self._name, self._now)


def _between(marks: list[float]) -> float:
    return statistics.median(end - start for start, end in pairwise(marks[1:]))


def _now_s() -> float:
    # A step already waits for its loss (`check_finite`), so waiting again changes little.
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def timed_fit(
    config: RunConfig,
    run: Path,
    options: dict[str, Any],
    matmul: str = "high",
    evaluate: Evaluate | None = None,
    ended: StageEnded = lambda name, times: None,
) -> dict[str, StageTimes]:
    """Train a run from its start, at least 3 epochs a stage; what the clock saw, by stage.

    Args:
        config: The run; see `paper_run`.
        run: A folder that does not exist yet.
        options: Lightning's: accelerator, devices, precision.
        matmul: How exact float32 matrix products are: `high` is TF32 where a GPU has it, and what
            `fit` uses; `highest` is float32.
        evaluate: What evaluates samples at each stage's end, if that is measured, too.
        ended: Told of each stage as soon as it is over: the next may be too much for the device.
    """
    clock = Clock(matmul, ended)
    if evaluate is None:
        unwatched = config.samples.model_copy(update={"every": 0})
        config = config.model_copy(update={"samples": unwatched})
    options = options | {"callbacks": [clock]}
    fit(config, run, loggers=("csv",), trainer_options=options, evaluate=evaluate)
    return clock.stages

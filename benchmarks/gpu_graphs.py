"""The part `graphs` of `gpu.py`: training with CUDA graphs against training without, its speed and
weights; the hours of the paper's schedule."""

import statistics
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from gpu_parts import PAPER_ROOMS, Setup, changes_of, peak_mib, shards_of
from lightning.pytorch.callbacks import Callback
from timed_fit import CONFIG, paper_run
from torch import Tensor

from sceneprior.apps.config import load_config
from sceneprior.core.settings import find_config
from sceneprior.paper.stages import PaperStage
from sceneprior.paper.static_step import StaticStep
from sceneprior.training import graphs
from sceneprior.training.fit import fit
from sceneprior.training.method import RunConfig, read_checkpoint

STAGES = ("layout", "shape")


class Pace(Callback):
    """The time from step to step with the loading of batches, synchronised only at both ends."""

    def __init__(self, matmul: str = "high") -> None:
        self.matmul = matmul
        self.steps_s: dict[str, list[float]] = {}
        """Mean seconds of a step, by stage and epoch."""
        self.epochs_s: dict[str, list[float]] = {}
        """Start times of the epochs, by stage."""

    def on_train_start(self, trainer, pl_module) -> None:
        torch.set_float32_matmul_precision(self.matmul)  # `fit` sets "high"
        self.stage = Path(trainer.default_root_dir).name
        self.steps_s[self.stage], self.epochs_s[self.stage] = [], []

    def on_train_epoch_start(self, trainer, pl_module) -> None:
        self.epochs_s[self.stage].append(_now_s())

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:
        self.steps = steps = int(trainer.num_training_batches)
        first = min(5, steps // 4)  # worker processes are ahead by then
        if batch_idx == first:
            self._began = _now_s()
        if batch_idx == steps - 1 > first:
            self.steps_s[self.stage].append((_now_s() - self._began) / (steps - 1 - first))

    def figures(self, stage: str, batch: int, epochs: int) -> dict[str, float]:
        """Milliseconds of a step and between epochs in the second half of the epochs, and the hours
        of a whole stage of the paper's rooms."""
        half = len(self.steps_s[stage]) // 2
        step_s = statistics.median(self.steps_s[stage][half:])
        starts = self.epochs_s[stage][half:]
        epoch_s = (starts[-1] - starts[0]) / (len(starts) - 1)
        between_s = max(epoch_s - self.steps * step_s, 0.0)
        whole = -(-PAPER_ROOMS * 4 // batch)
        hours = epochs * (whole * step_s + between_s) / 3600
        return {"step_ms": 1e3 * step_s, "between_epochs_ms": 1e3 * between_s, "whole_h": hours}


def _now_s() -> float:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


@contextmanager
def told_failures() -> Iterator[None]:
    """Print the whole error of a capture that fails; `fit` says one line, and goes on."""
    capture = graphs.captured

    def told(function: Any, samples: tuple[Tensor, ...]) -> Any:
        start = time.perf_counter()
        try:
            found = capture(function, samples)
        except Exception:
            print("A CAPTURE FAILED:", traceback.format_exc(), flush=True)
            raise
        print(f"captured in {time.perf_counter() - start:.2f} s", flush=True)
        return found

    graphs.captured = told
    try:
        yield
    finally:
        graphs.captured = capture


@contextmanager
def plain_calls() -> Iterator[None]:
    """Replace captures by plain calls of the same functions."""
    capture = graphs.captured
    graphs.captured = lambda function, samples: function
    try:
        yield
    finally:
        graphs.captured = capture


def speed(setup: Setup, batch: int) -> None:
    """Time both stages of the paper's run, with graphs and without."""
    whole = load_config(str(find_config(CONFIG)))
    hours = {"graphs": 0.0, "eager": 0.0}
    many = batch > setup.sizes.rooms and setup.device != "cpu"
    for how in hours:
        config = _run(setup, batch, how == "graphs", *(("data.workers=8",) if many else ()))
        pace = Pace()
        tried = _tried(setup, f"{how}, {batch} rooms")
        with peak_mib(setup.device) as peak, tried, told_failures():
            _fit(setup, config, [pace], setup.sizes.steps)
            for stage in STAGES:
                figures = pace.figures(stage, batch, getattr(whole, stage).epochs)
                hours[how] += figures["whole_h"]
                what = f"{stage} stage, {how}, {batch} rooms per batch"
                setup.note(what, figures | {"peak_mib": peak()})
            what = f"all of {CONFIG} on {PAPER_ROOMS:,} rooms, {how}, {batch} rooms per batch"
            setup.note(what, {"whole_h": hours[how]})


def same_training(setup: Setup) -> None:
    """Compare the weights after 20 steps of each stage with those of plain training.

    `off` is the distance of the weights over the distance that they moved. The noise of float32 is
    its value for the same functions without graphs ('plain calls'), or in another order ('eager').
    """
    few: tuple[str, ...] = (
        "data.workers=0",
        f"data.views_per_room={min(5, 2 * setup.sizes.rooms)}",
    )
    few += ("layout.epochs=1", "shape.epochs=1")
    ends: dict[str, dict[str, dict[str, Tensor]]] = {}
    for rate in (0.0, 0.1):
        rated = (*few, f"model.decoder.dropout={rate}")
        for how in ("graphs", "plain calls", "eager") if rate == 0 else ("graphs", "plain calls"):
            config = _run(setup, setup.sizes.rooms, how != "eager", *rated)
            with _tried(setup, f"{how}, dropout {rate}"), tempfile.TemporaryDirectory() as name:
                with plain_calls() if how == "plain calls" else told_failures():
                    _fit(
                        setup,
                        config,
                        [Pace("highest")],
                        setup.sizes.compared_steps,
                        Path(name) / "run",
                    )
                ends[how] = {stage: _weights(Path(name) / "run", stage) for stage in STAGES}
        start = _start(config)
        for one, other in (
            ("graphs", "plain calls"),
            ("graphs", "eager"),
            ("plain calls", "eager"),
        ):
            if one in ends and other in ends:
                of = f"{one} and {other}, dropout {rate}"
                _compare(setup, of, ends[one], ends[other], start)
        ends = {}


def graphs_part(setup: Setup) -> None:
    """Measure what matters most first, since a lease is short."""
    speed(setup, setup.sizes.rooms)
    same_training(setup)
    speed(setup, setup.sizes.large_batch)


def _compare(setup: Setup, of: str, one: Any, other: Any, start: dict[str, Tensor]) -> None:
    before = start
    for stage in STAGES:
        names = [name for name in other[stage] if other[stage][name].is_floating_point()]
        moved = torch.cat([(other[stage][name] - before[name]).flatten() for name in names])
        apart = torch.cat([(one[stage][name] - other[stage][name]).flatten() for name in names])
        off = float(apart.norm() / moved.norm())
        figures = {"off": off, "largest": float(apart.abs().max()), "moved": float(moved.norm())}
        setup.note(f"{stage} stage: {of}", figures)
        before = other[stage]


def _run(setup: Setup, batch: int, with_graphs: bool, *changes: str) -> RunConfig:
    graphed = tuple(f"{stage}.cuda_graphs={str(with_graphs).lower()}" for stage in STAGES)
    # Loader processes of the shape stage have then read most images.
    epochs = () if setup.device == "cpu" else ("shape.epochs=6",)
    sizes = changes_of(setup, batch)
    return paper_run(shards_of(setup), 3, *epochs, *sizes, *graphed, *changes)


def _fit(
    setup: Setup, config: RunConfig, callbacks: list[Callback], steps: int, run: Path | None = None
) -> None:
    options: dict[str, Any] = {"accelerator": setup.device, "devices": 1}
    options["limit_train_batches"] = steps
    with tempfile.TemporaryDirectory() as name, static_steps(setup.device):
        run = run or Path(name) / "run"
        fit(config, run, loggers=("csv",), trainer_options=options, callbacks=callbacks)


@contextmanager
def static_steps(device: str) -> Iterator[None]:
    """In a trial on a CPU, take the steps that are captured on a GPU, as plain calls."""

    def use(stage: PaperStage, trainer: Any) -> bool:
        if stage.stage.cuda_graphs:
            stage.static = StaticStep(
                stage.prior, stage.stage, stage.loss, stage.completeness_target
            )
        return stage.stage.cuda_graphs

    with patch.object(PaperStage, "use_graphs", use) if device == "cpu" else nullcontext():
        yield


@contextmanager
def _tried(setup: Setup, what: str) -> Iterator[None]:
    """Go on after an error, which is printed and becomes a row."""
    print(f"{what} ...", flush=True)
    start = time.perf_counter()
    try:
        yield
    except Exception as error:
        print(traceback.format_exc(), flush=True)
        setup.note(f"{what}: {' '.join(str(error).split())[:200]}", {})
    print(f"{what}: {time.perf_counter() - start:.1f} s", flush=True)


def _rows(config: RunConfig) -> int:
    return len(config.stages()[0].open_data())


def _weights(run: Path, stage: str) -> dict[str, Tensor]:
    return read_checkpoint(run / stage / "final.ckpt")["state_dict"]


def _start(config: RunConfig) -> dict[str, Tensor]:
    return config.networks("layout", _rows(config)).state_dict()

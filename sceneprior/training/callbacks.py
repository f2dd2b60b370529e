"""Lightning callbacks: progress, a seed for each batch, statistics, pictures, `last.ckpt` after
each epoch; and SLURM: a job stops in time and is requeued (docs/cluster.md)."""

import contextlib
import math
import os
import shutil
import signal
import subprocess
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.environments import SLURMEnvironment
from lightning.pytorch.utilities import rank_zero_only
from rich import progress
from rich.console import Console
from torch import nn
from torch.optim.lr_scheduler import OneCycleLR

from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.files import write_whole
from sceneprior.core.repeatable import LARGEST_SEED
from sceneprior.render.appearance import contact_sheet
from sceneprior.render.topdown import floor_plan
from sceneprior.training.method import RunConfig, Stage, read_checkpoint
from sceneprior.training.steps import batch_seed

_RESUMED = ("epoch", "global_step", "loops", "optimizer_states", "pytorch-lightning_version")
"""Keys of a checkpoint that the trainer needs to resume, in addition to the weights."""
PICTURED = 4
"""Number of rooms in a picture."""
DRAWING = 0.02
"""Share of a stage's time beyond which no more pictures are drawn; one more at most doubles it."""


class RunProgress(Callback):
    """A progress bar for the whole stage, with the latest loss, on standard error."""

    def __init__(self, title: str):
        self.title = title
        self._progress: progress.Progress | None = None
        self._task = progress.TaskID(0)

    def on_train_start(self, trainer: lightning.Trainer, pl_module) -> None:
        if not trainer.is_global_zero:
            return
        self._progress = progress.Progress(
            progress.TextColumn("{task.description}"), progress.BarColumn(),
            progress.MofNCompleteColumn(), progress.TextColumn("{task.fields[loss]}"),
            progress.TimeElapsedColumn(), progress.TimeRemainingColumn(),
            console=Console(stderr=True),
        )  # fmt: skip
        self._progress.start()
        self._task = self._progress.add_task(
            self.title, total=trainer.max_epochs, completed=trainer.current_epoch, loss=""
        )

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module) -> None:
        # Reading a metric reduces it over the processes, so all of them must read it.
        loss = trainer.callback_metrics.get("train/loss")
        if self._progress is not None:
            text = "" if loss is None else f"loss {float(loss):.4f}"
            self._progress.update(self._task, completed=trainer.current_epoch + 1, loss=text)

    def on_train_end(self, *_: Any) -> None:
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def on_exception(self, *_: Any) -> None:
        self.on_train_end()


class StepSeed(Callback):
    """Seed each batch separately, so that a resumed run draws the same dropout."""

    def __init__(self, seed: int):
        self.seed = seed

    def on_train_batch_start(self, trainer: lightning.Trainer, pl_module, batch, batch_idx) -> None:
        seed = batch_seed(self.seed, trainer, batch_idx)
        if pl_module.device.type == "cuda":  # `torch.manual_seed` takes most of a millisecond
            torch.default_generator.manual_seed(seed)
            torch.cuda.manual_seed(seed)
        else:
            torch.manual_seed(seed)


class Statistics(Callback):
    """Logs, once per epoch, the learning rates (`lr/<parameter group>`), the norm of the gradients
    in the last step before clipping, and the standard deviation of the latents' logits."""

    def on_before_optimizer_step(self, trainer: lightning.Trainer, pl_module, optimizer) -> None:
        if trainer.fit_loop.epoch_loop.batch_progress.is_last_batch:
            gradients = [each.grad for each in pl_module.parameters() if each.grad is not None]
            norm = nn.utils.get_total_norm(gradients)
            pl_module.log("train/gradient_norm", norm, on_step=False, on_epoch=True, batch_size=1)

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module) -> None:
        groups = [group for optimizer in trainer.optimizers for group in optimizer.param_groups]
        said = {f"lr/{index}": float(group["lr"]) for index, group in enumerate(groups)}
        latents = getattr(pl_module, "latents", None)
        if latents is not None and latents.weight.requires_grad and latents.weight.numel() > 1:
            said["train/latents_std"] = float(latents.weight.detach().std())
        pl_module.log_dict(said)


class Pictures(Callback):
    """Draws floor plans of a few rooms for TensorBoard and W&B, every `val_every` epochs and at the
    end, within `DRAWING`. The stage's module makes the rooms (`examples`)."""

    def __init__(self, config: RunConfig, stage: Stage, room_ids: Sequence[str]):
        self.config, self.stage, self.room_ids = config, stage, tuple(room_ids)
        self.started_s, self.spent_s, self.drawn_at = time.monotonic(), 0.0, -1

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module) -> None:
        every = self.stage.settings.val_every
        if every and (trainer.current_epoch + 1) % every == 0:
            self.draw(trainer, pl_module)

    def on_train_end(self, trainer: lightning.Trainer, pl_module) -> None:
        if self.stage.settings.val_every and self.drawn_at < trainer.global_step:
            self.draw(trainer, pl_module)

    def draw(self, trainer: lightning.Trainer, pl_module) -> None:
        """Log a picture of each group of rooms."""
        boards = [each for each in trainer.loggers if isinstance(each, TensorBoardLogger)]
        others: list[Any] = [each for each in trainer.loggers if hasattr(each, "log_image")]
        make = getattr(pl_module, "examples", None)
        if make is None or not (trainer.is_global_zero and (boards or others)):
            return
        start_s = time.monotonic()
        if self.spent_s > DRAWING * (start_s - self.started_s):
            return
        self.drawn_at = trainer.global_step
        trained = self.config.trained(pl_module, self.stage.name, self.room_ids)
        with contextlib.suppress(InputError):  # a network of few epochs may draw no valid room
            for name, scenes in make(trained, PICTURED).items():
                picture = contact_sheet([floor_plan(scene) for scene in scenes], 2)
                key, step = f"rooms/{name}", trainer.global_step
                for board in boards:
                    board.experiment.add_image(key, picture, step, dataformats="HWC")
                for other in others:
                    other.log_image(key, [picture], step)
        self.spent_s += time.monotonic() - start_s


class RollingCheckpoint(Callback):
    """Write `last.ckpt` after every epoch, the only point at which a run can be resumed exactly;
    and its copy `best.ckpt` whenever the metric `monitor` is the least so far.

    An interrupted run loses the current epoch. The resumed run draws the views of that epoch again,
    and ends at the same weights as an uninterrupted run. The entries of `extra` (plain data) are
    added to every checkpoint.
    """

    def __init__(self, folder: Path, extra: dict, monitor: str = "val/loss"):
        self.folder, self.extra, self.monitor = folder, extra, monitor
        self.written, self.best = False, math.inf

    def on_load_checkpoint(self, trainer, pl_module, checkpoint: dict) -> None:
        self.best = float(checkpoint.get("best", math.inf))

    def on_train_start(self, trainer: lightning.Trainer, pl_module) -> None:
        """Check what was restored: torch's fused optimizers read beyond tensors of other shapes."""
        if trainer.ckpt_path is None:
            return
        for optimizer in trainer.optimizers:
            for parameter, state in optimizer.state.items():
                for value in state.values() if isinstance(state, dict) else (state,):
                    if not isinstance(value, torch.Tensor) or (
                        value.ndim
                        and (value.shape, value.dtype) != (parameter.shape, parameter.dtype)
                    ):
                        path = Path(str(trainer.ckpt_path))
                        raise not_resumed(path, "its optimizer's state is of another network")
        planned = int(trainer.estimated_stepping_batches) + 1
        for schedule in (each.scheduler for each in trainer.lr_scheduler_configs):
            if isinstance(schedule, OneCycleLR) and schedule.total_steps != planned:
                for phase in schedule._schedule_phases:
                    phase["end_step"] = (phase["end_step"] + 1) * planned / schedule.total_steps - 1
                schedule.total_steps = planned
                said = "the learning rates go on from where a run of that length would be"
                said = f"The cosine schedule is stretched to the new number of epochs: {said}."
                warnings.warn(said, InputWarning, stacklevel=1)

    def on_save_checkpoint(self, trainer, pl_module, checkpoint: dict) -> None:
        checkpoint.update(self.extra, best=self.best)

    def on_train_epoch_start(self, trainer: lightning.Trainer, pl_module) -> None:
        if trainer.current_epoch + 1 == trainer.max_epochs:
            trainer.check_val_every_n_epoch = 1

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module) -> None:
        loss = float(trainer.callback_metrics.get(self.monitor, math.inf))
        better, self.best = loss < self.best, min(loss, self.best)
        # The best first: a run stopped between the two writes repeats this epoch when it goes on.
        write_checkpoint(trainer, self.folder, "best.ckpt" if better else "last.ckpt")
        if better:
            copy_checkpoint(trainer, self.folder, "best.ckpt", "last.ckpt")
        self.written = True


def write_checkpoint(trainer: lightning.Trainer, folder: Path, name: str) -> None:
    """Write a checkpoint atomically; every process calls this, and the first one writes."""
    if trainer.is_global_zero:
        write_whole(folder / name, trainer.save_checkpoint)
    else:
        trainer.save_checkpoint(folder / name)  # collective: takes part, but writes nothing
    # Other processes may be about to read it.
    trainer.strategy.barrier()


def copy_checkpoint(trainer: lightning.Trainer, folder: Path, name: str, copy: str) -> None:
    """Copy a checkpoint atomically; every process calls this, and the first one writes."""
    if trainer.is_global_zero:
        write_whole(folder / copy, lambda path: shutil.copyfile(folder / name, path))
    trainer.strategy.barrier()


def check_resumable(path: Path, module: nn.Module) -> None:
    """Check that a stage can be resumed from a checkpoint."""
    saved = read_checkpoint(path)
    missing = [name for name in _RESUMED if name not in saved]
    shapes = {name: getattr(value, "shape", None) for name, value in saved["state_dict"].items()}
    expected = {name: value.shape for name, value in module.state_dict().items()}
    if missing or shapes != expected:
        raise not_resumed(
            path, f"it has no {missing[0]}" if missing else "its tensors are of another network"
        )
    if not _counts_up([saved["loops"], saved["epoch"], saved["global_step"]]):
        raise not_resumed(path, "its counts of steps are no numbers, or negative")


def not_resumed(path: Path, reason: str) -> InputError:
    """The error of a checkpoint from which no training can be resumed."""
    return InputError(
        f"Training cannot be resumed from {path}: {reason}. Delete it, and the same command "
        "trains the stage from its start."
    )


def _counts_up(counts: Any) -> bool:
    if isinstance(counts, dict | list):
        return all(map(_counts_up, counts.values() if isinstance(counts, dict) else counts))
    return isinstance(counts, int) and 0 <= counts < LARGEST_SEED


def first_process() -> bool:
    """True in the process that writes files: rank 0 over all nodes."""
    return getattr(rank_zero_only, "rank", 0) == 0


def slurm_plugins() -> list[Any]:
    """Lightning's SLURM environment, with requeueing turned off.

    Lightning's requeueing saves in the middle of an epoch, where a run cannot be resumed exactly,
    and into the current folder, where the next stage would mistake the file for its own.
    """
    return [SLURMEnvironment(auto_requeue=False)] if SLURMEnvironment.detect() else []


@contextlib.contextmanager
def requeue_on_signal() -> Iterator[None]:
    """In a SLURM job, handle SIGUSR1 by requeueing the job and stopping as Ctrl-C does.

    Nothing needs to be saved at that point: `last.ckpt` holds the state after the last complete
    epoch, and a resumed run repeats the interrupted epoch with the same views. SIGTERM, which SLURM
    sends before it preempts and requeues a job itself, stops training after the current batch.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not (SLURMEnvironment.detect() and in_main_thread):
        yield
        return

    def leave(number: int, frame: object) -> None:
        signal.signal(number, signal.SIG_IGN)  # srun may send the signal twice
        if first_process():
            # Requeued first, while there is time: SLURM then sends SIGTERM.
            job = os.environ["SLURM_JOB_ID"]
            if array := os.environ.get("SLURM_ARRAY_JOB_ID"):
                job = f"{array}_{os.environ['SLURM_ARRAY_TASK_ID']}"
            subprocess.run(["scontrol", "requeue", job], check=False)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGUSR1, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGUSR1, before)

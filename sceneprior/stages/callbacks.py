"""What happens beside the training step: progress, checkpoints and a clean stop."""

import contextlib
from pathlib import Path

import lightning
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


class RunProgress(Callback):
    """One bar for the whole stage, with the newest loss; on the error stream."""

    def __init__(self, title: str):
        self.title = title
        self._progress: Progress | None = None
        self._task = None

    def on_train_start(self, trainer: lightning.Trainer, pl_module) -> None:
        if not trainer.is_global_zero:
            return
        self._progress = Progress(
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
            TextColumn("{task.fields[loss]}"), TimeElapsedColumn(), TimeRemainingColumn(),
            console=Console(stderr=True),
        )  # fmt: skip
        self._progress.start()
        self._task = self._progress.add_task(
            self.title, total=trainer.max_epochs, completed=trainer.current_epoch, loss=""
        )

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module) -> None:
        if self._progress is not None:
            loss = trainer.callback_metrics.get("train/loss")
            text = "" if loss is None else f"loss {float(loss):.4f}"
            self._progress.update(self._task, completed=trainer.current_epoch + 1, loss=text)

    def _stop(self) -> None:
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def on_train_end(self, trainer: lightning.Trainer, pl_module) -> None:
        self._stop()

    def on_exception(self, trainer: lightning.Trainer, pl_module, exception) -> None:
        self._stop()


class RollingCheckpoint(Callback):
    """Keep `last.ckpt` fresh: every few epochs and when the run is interrupted.

    Args:
        folder: Where it goes.
        every: Epochs between two writes.
        extra: Plain data stored under its own key.
    """

    def __init__(self, folder: Path, every: int, extra: dict):
        self.folder, self.every, self.extra = folder, every, extra

    def on_save_checkpoint(self, trainer, pl_module, checkpoint: dict) -> None:
        checkpoint.update(self.extra)

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module) -> None:
        if (trainer.current_epoch + 1) % self.every == 0:
            self.write(trainer, "last.ckpt")

    def write(self, trainer: lightning.Trainer, name: str) -> None:
        """Write to a temporary name and move into place."""
        part = self.folder / f"{name}.part"
        trainer.save_checkpoint(part)
        if trainer.is_global_zero:
            part.replace(self.folder / name)

    def on_exception(self, trainer: lightning.Trainer, pl_module, exception) -> None:
        # Only a stop by hand: after an error the state may be the error's.
        if isinstance(exception, KeyboardInterrupt):
            with contextlib.suppress(OSError):
                self.write(trainer, "last.ckpt")

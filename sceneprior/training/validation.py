"""Validation in Lightning's own loop: the losses `val/*`, and `val_rooms/*` of rooms that training
does not know, each with a latent fitted in a few steps."""

import warnings
from pathlib import Path
from typing import Any

import lightning
import torch
from torch import nn
from torch.utils.data import DataLoader, default_convert

from sceneprior.core.dataset import BLANK
from sceneprior.core.errors import InputError, InputWarning
from sceneprior.training.method import Stage

ROWS = 64
"""Maximum number of rows on which a stage is validated."""
FITTED_ROOMS = 8
"""Maximum number of val rooms whose latents are fitted."""
FIT_STEPS, FIT_RATE = 30, 0.3
"""Number of steps of Adam by which they are fitted, and its learning rate."""
STEPS_BETWEEN = 60 * FIT_STEPS
"""Minimum number of training steps between two fits, which so take at most 2% of the time."""


class ValidatedModule(lightning.LightningModule):
    """A module whose training step, called in evaluation mode, computes the losses `val/*`."""

    latents: nn.Embedding
    """The rooms' latents, in a module that has some."""

    def validation_step(self, batch: Any, batch_idx: int, dataloader_idx: int = 0) -> None:
        """The losses of a batch; the second loader has val rooms, whose latents are fitted."""
        if dataloader_idx == 0:
            self.training_step(batch, batch_idx)
            return
        every = self.trainer.check_val_every_n_epoch or 1
        steps = every * int(self.trainer.num_training_batches)
        if ((self.current_epoch + 1) // every) % -(-STEPS_BETWEEN // steps) == 0:
            self._fit_latents(batch)

    def _fit_latents(self, batch: Any) -> None:
        """Log the losses of rooms as `val_rooms/*`, after their latents alone were trained."""
        trained = self.latents
        rows = int(batch.room_index.max()) + 1
        start = torch.zeros(rows, trained.embedding_dim, device=self.device)
        self.latents = fitted = nn.Embedding.from_pretrained(start, freeze=False)
        optimizer = torch.optim.Adam(fitted.parameters(), lr=FIT_RATE)
        try:
            self.log_as = ""  # nothing is logged
            for _ in range(FIT_STEPS):
                with torch.enable_grad():
                    loss: Any = self.training_step(batch, 0)
                (fitted.weight.grad,) = torch.autograd.grad(loss, [fitted.weight])
                optimizer.step()
            self.log_as = "val_rooms"
            self.training_step(batch, 0)
        finally:
            self.latents = trained
            del self.log_as


def val_loaders(
    stage: Stage, module: lightning.LightningModule, rooms: Any, shards: Path, *process: int
) -> list[DataLoader] | None:
    """Loaders of what a stage is validated on, the same rows and views each time; None if there is
    nothing, or if the module has its own. `process` is its rank and the number of processes.

    A module with latents is validated on the training rooms, in views that training does not use if
    there are any, and on val rooms with fitted latents; another on the val rooms.
    """
    if not (stage.settings.val_every and isinstance(module, ValidatedModule)):
        return None
    val, size = None, stage.settings.batch_size
    try:
        val = stage.open_val() if stage.open_val is not None else None
    except InputError as error:
        if (shards / "val").exists():
            said = f"{stage.name} is not validated on the val rooms of {shards}: {error}"
            warnings.warn(said, InputWarning, stacklevel=2)
    if not hasattr(module, "latents"):
        return None if val is None else [_loader(val, ROWS, size, *process)]
    fitted = [] if val is None else [_loader(val, FITTED_ROOMS, FITTED_ROOMS)]  # by each process
    return [_loader(rooms.for_validation(), ROWS, size, *process), *fitted]


def _loader(rooms: Any, most: int, size: int, rank: int = 0, world: int = 1) -> DataLoader:
    """Batches of at most `most` rows, evenly spaced in `rooms`, split over processes."""
    count = min(most, len(rooms))
    rows = [index * len(rooms) // count for index in range(count)]
    batches = [rows[at : at + size * world] for at in range(0, count, size * world)]
    draws = [[(row, 0) for row in batch[rank::world]] or [(batch[0], BLANK)] for batch in batches]
    own = torch.Generator()  # since a loader draws a seed, which would change training
    return DataLoader(rooms, batch_sampler=draws, collate_fn=default_convert, generator=own)

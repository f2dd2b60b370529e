"""What the two methods that learn from true boxes in 3D share: their config, loss and optimiser."""

from abc import abstractmethod
from pathlib import Path
from typing import Any, Literal

import lightning
import torch
from jaxtyping import Float
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from pydantic import Field
from torch import Tensor, nn

from sceneprior.baselines.true_boxes import TruthDataset
from sceneprior.losses.averages import share_of_batch
from sceneprior.training.checkpoints import read_checkpoint, restore, saved_room_ids
from sceneprior.training.method import RunConfig, Stage, TrainedSampler, check_rooms, ready_copy
from sceneprior.training.objective import check_finite, log_losses, with_cosine
from sceneprior.training.settings import TrainConfig
from sceneprior.views import RoomBoxes


class BoxTraining(TrainConfig):
    """How a method is trained that learns from boxes in 3D."""

    batch_size: int = Field(ge=1)
    """Rooms a batch and process."""
    learning_rate: float = Field(gt=0)
    schedule: Literal["constant", "cosine"] = "constant"
    """`constant` (published, both), or a short rise and a `cosine` down to zero."""


class BoxConfig(RunConfig):
    """A run that learns from true boxes; its only stage has the method's name."""

    training: BoxTraining

    @abstractmethod
    def build_network(self) -> nn.Module:
        """The network, freshly initialised from the seed; it has `sample` (see `BoxSampler`)."""

    @abstractmethod
    def build(self, rooms: TruthDataset, previous: Path | None) -> lightning.LightningModule:
        """The module to train, with statistics of the training rooms."""

    def stages(self) -> tuple[Stage, ...]:
        return (Stage(self.method, self.training, self._open, self.build),)

    def load(self, stage: str, path: Path) -> TrainedSampler:
        saved = read_checkpoint(path)
        network: Any = self.build_network()
        restore({"prior": network}, saved, path)
        network.eval().requires_grad_(False)
        return TrainedSampler(network, saved_room_ids(saved, path), self, stage)

    def trained(
        self, networks: lightning.LightningModule, stage: str, room_ids: tuple[str, ...]
    ) -> TrainedSampler:
        return TrainedSampler(ready_copy(networks.prior), room_ids, self, stage)

    @property
    def _most(self) -> int | None:
        """Objects that a room can have."""
        return None

    def _open(self) -> TruthDataset:
        rooms = TruthDataset(Path(self.data.shards), "train", self.data.rotations)
        check_rooms(rooms, self, self._most)
        return rooms


def total_of_rooms(
    stage: lightning.LightningModule,
    rooms: RoomBoxes,
    losses: dict[str, Float[Tensor, " rooms"]],
    weights: dict[str, float],
    beside: dict[str, Float[Tensor, ""]] | None = None,
) -> Float[Tensor, ""]:
    """Mean over rooms of the weighted sum of their terms; logged, term by term.

    Args:
        stage: Logs under `train/`.
        rooms: The batch; of several processes' batches, each room with an id counts the same.
        losses: Of each room, by name.
        weights: Of the terms; 1 where none is given.
        beside: Logged, too, but not minimised.

    Raises:
        FloatingPointError: the total is NaN or infinite; names the rooms.
    """
    count = len(rooms.room_ids)
    share = share_of_batch(torch.tensor(count, device=rooms.boxes_m.device))
    means = {name: share * loss.sum() / max(count, 1) for name, loss in losses.items()}
    total = torch.stack([weights.get(name, 1.0) * mean for name, mean in means.items()]).sum()
    check_finite(total, rooms)
    log_losses(stage, means | (beside or {}), total, max(count, 1))
    return total


def build_box_optimizer(
    network: nn.Module, settings: BoxTraining, steps: int
) -> torch.optim.Optimizer | OptimizerLRSchedulerConfig:
    """Adam with the stage's schedule over `steps` updates."""
    optimizer = torch.optim.Adam(network.parameters(), lr=settings.learning_rate)
    return optimizer if settings.schedule == "constant" else with_cosine(optimizer, steps)

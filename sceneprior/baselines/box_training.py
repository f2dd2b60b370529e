"""What the two methods that learn from true boxes in 3D share: their config and their stage."""

from abc import ABC, abstractmethod
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
from sceneprior.settings import Section
from sceneprior.training.method import RunConfig, Stage, TrainedSampler, ready_copy
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

    model: Section
    training: BoxTraining

    @abstractmethod
    def make(self) -> "BoxStage":
        """The module to train, with a fresh network that knows no rooms yet."""

    def build(self, rooms: TruthDataset, previous: Path | None) -> "BoxStage":
        """The module to train, with statistics of the training rooms."""
        torch.manual_seed(self.seed)
        stage = self.make()
        stage.prior.fit_statistics(rooms.everything())
        return stage

    def stages(self) -> tuple[Stage, ...]:
        return (Stage(self.method, self.training, self._open, self.build),)

    def networks(self, stage: str, rooms: int) -> nn.ModuleDict:
        torch.manual_seed(self.seed)
        return nn.ModuleDict({"prior": self.make().prior})

    def trained(self, networks: nn.Module, stage: str, room_ids: tuple[str, ...]) -> TrainedSampler:
        return TrainedSampler(ready_copy(networks.prior), room_ids, self, stage)

    def _open(self) -> TruthDataset:
        rooms = TruthDataset(Path(self.data.shards), "train", self.data.rotations)
        self.check_rooms(rooms, getattr(self.model, "max_objects", None))
        return rooms


class BoxStage(lightning.LightningModule, ABC):
    """Minimises the mean over rooms of the weighted sum of their terms.

    `prior` is a `BoxSampler`, which has `fit_statistics(rooms)`.
    """

    def __init__(self, prior: Any, settings: BoxTraining, seed: int):
        super().__init__()
        self.prior, self.settings, self.seed = prior, settings, seed

    @abstractmethod
    def training_step(self, rooms: RoomBoxes, batch_idx: int) -> Tensor:
        """The loss of a batch."""

    def total(
        self,
        rooms: RoomBoxes,
        losses: dict[str, Float[Tensor, " rooms"]],
        weights: dict[str, float],
        beside: dict[str, Float[Tensor, ""]],
    ) -> Float[Tensor, ""]:
        """The loss of a batch, checked and logged term by term; each room with an id counts the
        same, of several processes' batches, too.

        A term weighs 1 where `weights` has none; `beside` is logged, too, but not minimised.
        """
        count = len(rooms.room_ids)
        share = share_of_batch(torch.tensor(count, device=self.device))
        means = {name: share * loss.sum() / max(count, 1) for name, loss in losses.items()}
        total = torch.stack([weights.get(name, 1.0) * mean for name, mean in means.items()]).sum()
        check_finite(total, rooms)
        log_losses(self, means | beside, total, max(count, 1))
        return total

    def configure_optimizers(self) -> torch.optim.Optimizer | OptimizerLRSchedulerConfig:
        optimizer = torch.optim.Adam(self.prior.parameters(), lr=self.settings.learning_rate)
        if self.settings.schedule == "constant":
            return optimizer
        return with_cosine(optimizer, int(self.trainer.estimated_stepping_batches))

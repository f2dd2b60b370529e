"""Config and Lightning module of the baselines that train one network in one stage."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Literal

import lightning
import torch
from jaxtyping import Float
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from pydantic import Field
from torch import Tensor, nn

from sceneprior.core.settings import Section
from sceneprior.core.views import RoomBoxes, SceneViews
from sceneprior.training.method import RunConfig, Stage, TrainConfig
from sceneprior.training.steps import check_finite, log_losses, with_cosine


class OneStageTraining(TrainConfig):
    """Settings of one network's training."""

    learning_rate: float = Field(gt=0)
    schedule: Literal["constant", "cosine"] = "constant"
    """`constant` keeps the rate; with `cosine`, it rises briefly and then falls to 0."""


class OneStageConfig(RunConfig):
    """A run whose only stage has the method's name."""

    model: Section
    training: OneStageTraining

    @abstractmethod
    def make(self) -> "OneStage":
        """The module to train, with a newly initialised network; `build` adds the statistics of the
        training rooms, if the method needs any."""

    @abstractmethod
    def open_rooms(self) -> Any:
        """The training rooms.

        Raises:
            InputError: they do not fit the config.
        """

    def build(self, rooms: Any, previous: Path | None) -> "OneStage":
        """The module to train, with statistics of the training rooms if it needs any."""
        torch.manual_seed(self.seed)
        return self.make()

    def stages(self) -> tuple[Stage, ...]:
        return (Stage(self.method, self.training, self.open_rooms, self.build),)

    def networks(self, stage: str, rooms: int) -> nn.ModuleDict:
        torch.manual_seed(self.seed)
        return nn.ModuleDict({"prior": self.make().prior})


class OneStage(lightning.LightningModule, ABC):
    """Minimises a weighted sum of losses with Adam."""

    def __init__(self, prior: Any, settings: OneStageTraining):
        super().__init__()
        self.prior, self.settings = prior, settings

    @abstractmethod
    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        """The loss of a batch."""

    def total(
        self,
        losses: dict[str, Float[Tensor, ""]],
        weights: dict[str, float],
        batch: RoomBoxes | SceneViews,
        logged: dict[str, Float[Tensor, ""]] | None = None,
    ) -> Float[Tensor, ""]:
        """The weighted sum of a batch's losses, after a check that it is finite.

        A loss without a weight has weight 1. All losses are logged, and so is `logged`.
        """
        total = torch.stack([weights.get(name, 1.0) * loss for name, loss in losses.items()]).sum()
        check_finite(total, batch.room_ids)
        log_losses(self, losses | (logged or {}), total, max(len(batch.room_ids), 1))
        return total

    def configure_optimizers(self) -> torch.optim.Optimizer | OptimizerLRSchedulerConfig:
        optimizer = torch.optim.Adam(self.prior.parameters(), lr=self.settings.learning_rate)
        if self.settings.schedule == "constant":
            return optimizer
        return with_cosine(optimizer, int(self.trainer.estimated_stepping_batches))

"""What the three baselines of single-view reconstruction share: their config and their stage."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Literal

import lightning
import torch
from jaxtyping import Float
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from pydantic import Field, model_validator
from torch import Tensor, nn

from sceneprior.data.dataset import ViewDataset
from sceneprior.settings import Section
from sceneprior.training.method import RunConfig, Stage, TrainedReconstructor, ready_copy
from sceneprior.training.objective import check_finite, log_losses, with_cosine
from sceneprior.training.settings import TrainConfig
from sceneprior.views import SceneViews


class SingleViewModel(Section):
    """Sizes of what every network has."""

    width: int = Field(128, ge=8)
    """Of the features of a mask."""


class SingleViewTraining(TrainConfig):
    """How a method is trained that answers images directly. Views a room are
    `data.views_per_room`, masks those of `data.mask_step`."""

    learning_rate: float = Field(1e-3, gt=0)
    schedule: Literal["constant", "cosine"] = "cosine"
    """As of `StageConfig`; `constant` keeps the rate."""


class SingleViewConfig(RunConfig):
    """A run that answers images directly; its only stage has the method's name."""

    model: SingleViewModel
    training: SingleViewTraining

    @model_validator(mode="after")
    def _nothing_is_without_effect(self) -> "SingleViewConfig":
        if self.data.augment_rotations:
            raise ValueError(
                f"data.augment_rotations is true, but method: {self.method} sees each room turned "
                "until the camera looks along +z, so that turned copies are all the same to it; "
                "set it to false"
            )
        if self.samples.every:
            raise ValueError(
                f"samples.every is {self.samples.every}, but method: {self.method} makes no new "
                "rooms to evaluate; set it to 0"
            )
        return self

    @abstractmethod
    def make(self) -> "SingleViewStage":
        """The module to train, with a fresh network that knows no rooms yet."""

    @abstractmethod
    def open_rooms(self) -> ViewDataset:
        """The training rooms; InputError if they do not fit the config."""

    def views_of(self, kind: type[ViewDataset] = ViewDataset, **more: Any) -> Any:
        """The training rooms with their masks, as a data set of some `kind`."""
        data = self.data
        rooms = kind(
            Path(data.shards), "train", views_per_room=data.views_per_room,
            view_fraction=data.view_fraction, mask_step=data.mask_step, seed=self.seed, **more,
        )  # fmt: skip
        self.check_rooms(rooms, None)
        return rooms

    def build(self, rooms: Any, previous: Path | None) -> "SingleViewStage":
        """The module to train, on these rooms."""
        torch.manual_seed(self.seed)
        return self.make()

    def stages(self) -> tuple[Stage, ...]:
        return (Stage(self.method, self.training, self.open_rooms, self.build),)

    def networks(self, stage: str, rooms: int) -> nn.ModuleDict:
        torch.manual_seed(self.seed)
        return nn.ModuleDict({"prior": self.make().prior})

    def trained(
        self, networks: nn.Module, stage: str, room_ids: tuple[str, ...]
    ) -> TrainedReconstructor:
        return TrainedReconstructor(ready_copy(networks.prior), room_ids, self, stage)


class SingleViewStage(lightning.LightningModule, ABC):
    """Minimises a weighted sum of means over masks. `prior` is a `ViewReconstructor`."""

    def __init__(self, prior: Any, settings: SingleViewTraining):
        super().__init__()
        self.prior, self.settings = prior, settings

    @abstractmethod
    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        """The loss of a batch."""

    def total(
        self, losses: dict[str, Float[Tensor, ""]], weights: dict[str, float], views: SceneViews
    ) -> Float[Tensor, ""]:
        """The loss of a batch, checked and logged term by term; one weighs 1 where `weights` has
        none."""
        total = torch.stack([weights.get(name, 1.0) * loss for name, loss in losses.items()]).sum()
        check_finite(total, views)
        log_losses(self, losses, total, len(views.room_ids))
        return total

    def configure_optimizers(self) -> torch.optim.Optimizer | OptimizerLRSchedulerConfig:
        optimizer = torch.optim.Adam(self.prior.parameters(), lr=self.settings.learning_rate)
        if self.settings.schedule == "constant":
            return optimizer
        return with_cosine(optimizer, int(self.trainer.estimated_stepping_batches))

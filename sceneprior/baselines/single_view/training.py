"""Config shared by the three baselines of single-view reconstruction."""

from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field, model_validator
from torch import nn

from sceneprior.baselines.one_stage import OneStageConfig, OneStageTraining
from sceneprior.core.data.dataset import ViewDataset
from sceneprior.core.settings import Section
from sceneprior.training.method import TrainedReconstructor, ready_copy
from sceneprior.training.settings import ViewDataConfig


class SingleViewModel(Section):
    """Size of a network."""

    width: int = Field(128, ge=8)
    """Width of a mask's features."""


class SingleViewTraining(OneStageTraining):
    """Settings of one network's training. `data.views_per_room` and `data.mask_step` set which
    views and which pixels it sees."""

    learning_rate: float = Field(1e-3, gt=0)
    schedule: Literal["constant", "cosine"] = "cosine"
    """As in `OneStageTraining`."""


class SingleViewConfig(OneStageConfig):
    """A run of a network that reconstructs the objects of single views."""

    data: ViewDataConfig
    model: SingleViewModel
    training: SingleViewTraining

    dataset: ClassVar[type[ViewDataset]] = ViewDataset
    """The training rooms' class."""

    @model_validator(mode="after")
    def _nothing_is_without_effect(self) -> "SingleViewConfig":
        if self.data.augment_rotations:
            raise ValueError(
                f"data.augment_rotations is true, but method: {self.method} sees each room turned "
                "until the camera looks along +z, so that turned copies are all the same to it; "
                "set it to false"
            )
        return self

    def open_rooms(self) -> Any:
        data = self.data
        rooms = self.dataset(
            Path(data.shards), "train", views_per_room=data.views_per_room,
            view_fraction=data.view_fraction, mask_step=data.mask_step, seed=self.seed,
        )  # fmt: skip
        self.check_rooms(rooms, None)
        return rooms

    def trained(
        self, networks: nn.Module, stage: str, room_ids: tuple[str, ...]
    ) -> TrainedReconstructor:
        return TrainedReconstructor(ready_copy(networks.prior), room_ids, self, stage)

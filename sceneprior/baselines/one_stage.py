"""Baselines that train one network in one stage: their config and LightningModule, and the data of
those that learn from true 3D boxes.

Only ATISS, Sync2Gen and the set flow train on true boxes; methods that learn from masks and 2D
boxes never open them (tests/baselines/test_true_boxes.py).
"""

import math
from abc import ABC, abstractmethod
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from pydantic import Field
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from sceneprior.core.boxes import turn_boxes
from sceneprior.core.dataset import BLANK, RoomDataset
from sceneprior.core.errors import ShardError
from sceneprior.core.scene import Scene
from sceneprior.core.settings import Section
from sceneprior.core.shards import RoomGroundTruth, Shard
from sceneprior.core.views import RoomBoxes, SceneViews
from sceneprior.paper.losses import share_of_batch
from sceneprior.training.method import RunConfig, Stage, TrainConfig, TrainedSampler, ready_copy
from sceneprior.training.steps import check_finite, log_losses, with_cosine
from sceneprior.training.validation import ValidatedModule


class OneStageTraining(TrainConfig):
    """Settings of one network's training."""

    learning_rate: float = Field(gt=0)
    """Learning rate of Adam, before the schedule."""
    schedule: Literal["constant", "cosine"] = "constant"
    """`constant` keeps the rate; with `cosine`, it rises briefly and then falls to 0."""

    def weight_of(self, loss: str) -> float:
        """Weight of a loss: the setting of the same name, or 1 if there is none."""
        return getattr(self, loss, 1.0)


class OneStageConfig(RunConfig):
    """A run whose only stage has the method's name."""

    model: Section
    training: OneStageTraining

    @abstractmethod
    def make(self) -> "OneStage":
        """The module to train, with a newly initialised network; `build` adds the statistics of the
        training rooms, if the method needs any."""

    @abstractmethod
    def open_rooms(self, split: str = "train") -> Any:
        """The rooms of a split.

        Raises:
            InputError: they do not fit the config.
        """

    def build(self, rooms: Any, previous: Path | None) -> "OneStage":
        """The module to train, with statistics of the training rooms if it needs any."""
        torch.manual_seed(self.seed)
        return self.make()

    def stages(self) -> tuple[Stage, ...]:
        val = partial(self.open_rooms, "val")
        return (Stage(self.method, self.training, self.open_rooms, self.build, val),)

    def networks(self, stage: str, rooms: int) -> nn.ModuleDict:
        torch.manual_seed(self.seed)
        return nn.ModuleDict({"prior": self.make().prior})


class OneStage(ValidatedModule, ABC):
    """Minimises a weighted sum of losses with Adam."""

    def __init__(self, prior: Any, config: OneStageConfig):
        super().__init__()
        self.prior, self.settings, self.seed = prior, config.training, config.seed

    @abstractmethod
    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        """The loss of a batch."""

    def total(
        self,
        losses: dict[str, Float[Tensor, ""]],
        batch: RoomBoxes | SceneViews,
        **logged: Float[Tensor, ""],
    ) -> Float[Tensor, ""]:
        """The weighted sum of a batch's losses, after a check that it is finite. All losses are
        logged, and so is `logged`."""
        weight_of = self.settings.weight_of
        total = torch.stack([weight_of(name) * loss for name, loss in losses.items()]).sum()
        check_finite(total, batch.room_ids)
        log_losses(self, losses | logged, total, max(len(batch.room_ids), 1))
        return total

    def examples(self, trained: Any, count: int) -> dict[str, list[Scene]]:
        """Rooms for pictures, `drawn` by the network if it generates rooms."""
        if not isinstance(trained, TrainedSampler):
            return {}
        names = [f"drawn_{row}" for row in range(count)]
        return {"drawn": trained.prior.sample(count, 0).to_scenes(trained.config.label_set, names)}

    def configure_optimizers(self) -> torch.optim.Optimizer | OptimizerLRSchedulerConfig:
        optimizer = torch.optim.Adam(self.prior.parameters(), lr=self.settings.learning_rate)
        if self.settings.schedule == "constant":
            return optimizer
        return with_cosine(optimizer, int(self.trainer.estimated_stepping_batches))


class TruthDataset(RoomDataset):
    """The boxes of all furniture in a split's rooms, visible to a camera or not, held in memory.

    Rows and rotations are those of `ViewDataset`. With rotations, each row is mirrored in every
    second epoch, so that two epochs contain the eight symmetries of each room.
    """

    counted = "objects"

    def __init__(self, folder: Path, split: str, rotations: int = 1):
        super().__init__(rotations)
        rooms = self.read_rooms(folder, split, _read_truth)
        classes = [torch.from_numpy(truth.object_class).long() for truth in rooms]
        boxes = [torch.from_numpy(np.hstack([room.centers_m, room.sizes_m])) for room in rooms]
        yaws = [torch.from_numpy(truth.yaw_rad) for truth in rooms]
        self._counts = torch.tensor([len(room) for room in classes])
        self.max_objects = int(self._counts.max())
        self._classes, self._boxes_m, self._yaw_rad = (
            pad_sequence(parts, batch_first=True) for parts in (classes, boxes, yaws)
        )

    def to(self, device: torch.device | str) -> "TruthDataset":
        """Move all boxes to `device`, where batches are then made."""
        self._counts, self._classes = self._counts.to(device), self._classes.to(device)
        self._boxes_m, self._yaw_rad = self._boxes_m.to(device), self._yaw_rad.to(device)
        return self

    def everything(self) -> RoomBoxes:
        """All rows as one batch, for statistics; with rotations, each row also comes mirrored."""
        epochs = 2 if self.rotations > 1 else 1
        return self.__getitems__(
            [(row, epoch) for epoch in range(epochs) for row in range(len(self))]
        )

    def __getitems__(self, draws: list[tuple[int, int]]) -> RoomBoxes:
        """A batch of rows; each draw is (row, epoch). The epoch `BLANK` gives an empty room without
        an id, which does not contribute to the loss."""
        device = self._counts.device
        rows = torch.tensor([row for row, _ in draws], device=device)
        epochs = torch.tensor([epoch for _, epoch in draws], device=device)
        shown = epochs != BLANK
        rooms = rows // self.rotations
        counts = self._counts[rooms] * shown
        widest = max(int(counts.max()), 1)
        is_object = torch.arange(widest, device=device) < counts[:, None]
        quarters = rows % self.rotations
        mirrored = ((rows + epochs) % 2 == 1) & (self.rotations > 1)
        sides = 1 - 2 * mirrored.unsqueeze(-1).to(self._yaw_rad)  # mirroring reverses the yaw
        yaw_rad = sides * self._yaw_rad[rooms, :widest] + math.pi / 2 * quarters.unsqueeze(-1)
        return RoomBoxes(
            object_class=self._classes[rooms, :widest] * is_object,
            is_object=is_object,
            boxes_m=turn_boxes(self._boxes_m[rooms, :widest], quarters, mirrored),
            room_ids=tuple(self.plain_ids[room] for room in rooms[shown].tolist()),
            yaw_rad=torch.remainder(yaw_rad + math.pi, 2 * math.pi) - math.pi,
        )


def check_ground_truth(shard: Shard, room_id: str) -> None:
    """Raise a `ShardError` if a room has no 3D ground truth."""
    if not shard.has_ground_truth(room_id):
        raise ShardError(
            f"{shard.path}, room {room_id} carries no 3D ground truth, which this method learns "
            "from. Take shards of a data set that has it, or a method that learns from masks "
            "(paper, lifted, gan, usl)."
        )


def _read_truth(shard: Shard, room_id: str) -> RoomGroundTruth:
    check_ground_truth(shard, room_id)
    return shard.read_ground_truth(room_id)


class BoxConfig(OneStageConfig):
    """A run that learns from true boxes. Its network is a `BoxSampler` with `fit_statistics`."""

    @property
    def learns_from(self) -> str:
        return "true boxes in 3D"

    def open_rooms(self, split: str = "train") -> TruthDataset:
        rooms = TruthDataset(Path(self.data.shards), split, self.data.rotations)
        self.check_rooms(rooms, getattr(self.model, "max_objects", None))
        return rooms

    def build(self, rooms: TruthDataset, previous: Path | None) -> OneStage:
        stage = super().build(rooms, previous)
        stage.prior.fit_statistics(rooms.everything())
        return stage

    def trained(self, networks: nn.Module, stage: str, room_ids: tuple[str, ...]) -> TrainedSampler:
        return TrainedSampler(ready_copy(networks.prior), room_ids, self, stage)


def room_means(
    losses: dict[str, Float[Tensor, " rooms"]], rooms: RoomBoxes
) -> dict[str, Float[Tensor, ""]]:
    """Mean of each loss over the rooms of all processes; rooms without an id are left out."""
    count = len(rooms.room_ids)
    share = share_of_batch(torch.tensor(count, device=rooms.boxes_m.device))
    return {name: share * loss.sum() / max(count, 1) for name, loss in losses.items()}

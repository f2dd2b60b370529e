"""Config and mean loss of the baselines that learn from true boxes in 3D, ATISS and Sync2Gen."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneprior.baselines.one_stage import OneStage, OneStageConfig
from sceneprior.baselines.true_boxes import TruthDataset
from sceneprior.core.views import RoomBoxes
from sceneprior.paper.losses.averages import share_of_batch
from sceneprior.training.method import TrainedSampler, ready_copy


class BoxConfig(OneStageConfig):
    """A run that learns from true boxes. Its network is a `BoxSampler` with `fit_statistics`."""

    @property
    def learns_from(self) -> str:
        return "true boxes in 3D"

    def open_rooms(self) -> TruthDataset:
        rooms = TruthDataset(Path(self.data.shards), "train", self.data.rotations)
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
    """Mean of each loss over the rooms that have an id, of all processes together."""
    count = len(rooms.room_ids)
    share = share_of_batch(torch.tensor(count, device=rooms.boxes_m.device))
    return {name: share * loss.sum() / max(count, 1) for name, loss in losses.items()}

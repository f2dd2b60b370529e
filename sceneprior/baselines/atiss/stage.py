"""The baseline ATISS with 3D supervision: its config, and its training by maximum likelihood."""

from dataclasses import replace
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor

from sceneprior.baselines.atiss.network import END, Atiss, AtissModel
from sceneprior.baselines.one_stage import OneStage, OneStageTraining
from sceneprior.baselines.true_boxes import BoxConfig, room_means
from sceneprior.core.views import RoomBoxes
from sceneprior.training.steps import batch_seed, full_precision


class AtissTraining(OneStageTraining):
    """The published settings. Do not clip gradients (docs/baselines_3d.md)."""

    epochs: int = Field(500, ge=1)
    """500 epochs are the published 100,000 steps for 6,300 rooms with turned copies."""
    batch_size: int = Field(128, ge=1)
    learning_rate: float = Field(1e-4, gt=0)


class AtissConfig(BoxConfig):
    """Config of a run of ATISS."""

    method: Literal["atiss"] = "atiss"
    model: AtissModel
    training: AtissTraining = AtissTraining()

    def make(self) -> "AtissStage":
        return AtissStage(Atiss(self.model, self.classes), self.training, self.seed)


class AtissStage(OneStage):
    """Maximises the likelihood of one object of each room, given some of the others."""

    prior: Atiss

    def __init__(self, prior: Atiss, settings: AtissTraining, seed: int):
        super().__init__(prior, settings)
        self.seed = seed

    def training_step(self, rooms: RoomBoxes, batch_idx: int) -> Tensor:
        placed, coming = part_of_rooms(rooms, batch_seed(self.seed, self.trainer, batch_idx))
        unit, next_unit = self.prior.to_unit(placed), self.prior.to_unit(coming)
        context = self.prior.context(placed.object_class, unit, placed.is_object)
        with full_precision(self.device):
            next_class = coming.object_class[:, 0]
            log_probs = self.prior.log_prob(context.float(), next_class, next_unit[:, 0])
            losses = {name: -log_prob for name, log_prob in log_probs.items()}
            return self.total(room_means(losses, rooms), {}, rooms)


def part_of_rooms(rooms: RoomBoxes, seed: int) -> tuple[RoomBoxes, RoomBoxes]:
    """Shuffle each room's n objects and keep the first k, with k drawn uniformly from 0 to n.

    Also returns the next object of each room, whose class is `END` if all objects are kept.
    """
    generator = torch.Generator().manual_seed(seed)
    count = rooms.is_object.sum(dim=1)
    device = rooms.boxes_m.device
    tickets = torch.rand(rooms.is_object.shape, generator=generator).to(device)
    order = tickets.masked_fill(~rooms.is_object, 2.0).argsort(dim=1)
    kept = (torch.rand(len(count), generator=generator).to(device) * (count + 1)).long()
    shuffled = rooms.take(order)
    placed = torch.arange(order.shape[1], device=device) < kept[:, None]
    coming = shuffled.take(kept[:, None].clamp(max=order.shape[1] - 1))
    more = (kept < count)[:, None]
    return (
        replace(shuffled, object_class=shuffled.object_class * placed, is_object=placed),
        replace(coming, object_class=coming.object_class.where(more, END), is_object=more),
    )

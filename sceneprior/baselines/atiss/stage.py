"""The baseline ATISS with 3D supervision: its config, and its training by maximum likelihood."""

from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import lightning
import torch
from pydantic import Field
from torch import Tensor

from sceneprior.baselines.atiss.network import END, Atiss, AtissModel
from sceneprior.baselines.box_training import (
    BoxConfig,
    BoxTraining,
    build_box_optimizer,
    total_of_rooms,
)
from sceneprior.baselines.true_boxes import TruthDataset
from sceneprior.training.objective import batch_number, full_precision, step_seed
from sceneprior.views import RoomBoxes


class AtissTraining(BoxTraining):
    """Do not clip gradients (docs/baselines_3d.md). The defaults are the published settings."""

    epochs: int = Field(500, ge=1)
    """With turned copies of 6,300 rooms these are the published 100,000 steps."""
    batch_size: int = Field(128, ge=1)
    learning_rate: float = Field(1e-4, gt=0)


class AtissConfig(BoxConfig):
    """A run of ATISS."""

    method: Literal["atiss"] = "atiss"
    model: AtissModel
    training: AtissTraining = AtissTraining()

    @property
    def _most(self) -> int:
        return self.model.max_objects

    def build_network(self) -> Atiss:
        torch.manual_seed(self.seed)
        return Atiss(self.model, self.classes)

    def build(self, rooms: TruthDataset, previous: Path | None) -> "AtissStage":
        network = self.build_network()
        network.fit_bounds(rooms.everything())
        return AtissStage(network, self.training, self.seed)


class AtissStage(lightning.LightningModule):
    """Maximum likelihood of one object of each room, given some of the others.

    Args:
        prior: The network, which knows the range of the training rooms' boxes.
        training: How it is trained.
        seed: Of the run.
    """

    def __init__(self, prior: Atiss, training: AtissTraining, seed: int):
        super().__init__()
        self.prior, self.training_settings, self.seed = prior, training, seed

    def training_step(self, rooms: RoomBoxes, batch_idx: int) -> Tensor:
        batch = batch_number(self.trainer, batch_idx)
        part = part_of_rooms(rooms, step_seed(self.seed, batch, self.global_rank))
        placed, coming = self.prior.to_unit(part.placed), self.prior.to_unit(part.coming)
        context = self.prior.context(part.placed.object_class, placed, part.placed.is_object)
        with full_precision(self.device):
            next_class = part.coming.object_class[:, 0]
            log_probs = self.prior.log_prob(context.float(), next_class, coming[:, 0])
            losses = {name: -log_prob for name, log_prob in log_probs.items()}
            return total_of_rooms(self, rooms, losses, weights={})

    def configure_optimizers(self):
        steps = int(self.trainer.estimated_stepping_batches)
        return build_box_optimizer(self.prior, self.training_settings, steps)


class PartialRooms(NamedTuple):
    """Rooms of which some objects are placed, and the one that is coming."""

    placed: RoomBoxes
    coming: RoomBoxes
    """One object a room; of class `END` where all objects are placed."""


def part_of_rooms(rooms: RoomBoxes, seed: int) -> PartialRooms:
    """Put each room's n objects in a random order, and keep the first 0 to n, each as likely."""
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
    return PartialRooms(
        replace(shuffled, object_class=shuffled.object_class * placed, is_object=placed),
        replace(coming, object_class=coming.object_class.where(more, END), is_object=more),
    )

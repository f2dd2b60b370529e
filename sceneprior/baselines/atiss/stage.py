"""Baseline with 3D supervision: ATISS learns the next object's class, position, angle and size."""

from dataclasses import replace
from typing import NamedTuple

import lightning
import torch
from torch import Tensor

from sceneprior.baselines.atiss.network import END, Atiss
from sceneprior.baselines.box_training import build_box_optimizer, total_of_rooms
from sceneprior.baselines.true_boxes import TruthDataset
from sceneprior.classes import label_set
from sceneprior.config import RunConfig
from sceneprior.training.objective import batch_number, full_precision, step_seed
from sceneprior.views import RoomBoxes


class Atiss3dStage(lightning.LightningModule):
    """Maximum likelihood of one object of each room, given some of the others.

    Args:
        prior: The network, which knows the range of the training rooms' boxes.
        config: The run.
    """

    def __init__(self, prior: Atiss, config: RunConfig):
        super().__init__()
        self.prior = prior
        self.config = config

    def training_step(self, rooms: RoomBoxes, batch_idx: int) -> Tensor:
        batch = batch_number(self.trainer, batch_idx)
        part = part_of_rooms(rooms, step_seed(self.config.seed, batch, self.global_rank))
        placed, coming = self.prior.to_unit(part.placed), self.prior.to_unit(part.coming)
        context = self.prior.context(part.placed.object_class, placed, part.placed.is_object)
        with full_precision(self.device):
            next_class = part.coming.object_class[:, 0]
            log_probs = self.prior.log_prob(context.float(), next_class, coming[:, 0])
            losses = {name: -log_prob for name, log_prob in log_probs.items()}
            return total_of_rooms(self, rooms, losses, weights={})

    def configure_optimizers(self):
        steps = int(self.trainer.estimated_stepping_batches)
        return build_box_optimizer(self.prior, self.config.atiss3d, steps)


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


def build_network(config: RunConfig) -> Atiss:
    """The network a config describes, freshly initialised from its seed."""
    torch.manual_seed(config.seed)
    settings = config.atiss3d
    return Atiss(
        classes=len(label_set(config.label_set)),
        max_objects=config.model.max_objects,
        width=settings.width,
        layers=settings.layers,
        heads=settings.heads,
        hidden=settings.hidden,
        mixtures=settings.mixtures,
        dropout=settings.dropout,
    )


def build(config: RunConfig, dataset: TruthDataset) -> Atiss3dStage:
    """The stage at its start."""
    prior = build_network(config)
    prior.fit_bounds(dataset.everything())
    return Atiss3dStage(prior, config)

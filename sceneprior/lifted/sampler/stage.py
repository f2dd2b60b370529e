"""The stage that trains the sampler, by maximum likelihood of the training rooms' objects."""

import copy
import math
from dataclasses import replace
from typing import Any

import lightning
import torch
from jaxtyping import Float, Int
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn

from sceneprior.core.scene import Scene
from sceneprior.lifted.drawing.draw import sample_scenes
from sceneprior.lifted.prototypes import PosedRooms
from sceneprior.lifted.sampler.frames import SYMMETRIES, turned_rooms
from sceneprior.lifted.sampler.network import RoomSampler, SamplerConfig
from sceneprior.lifted.sampler.rooms import SamplerRooms, frames_of, large_first, shuffled
from sceneprior.lifted.trained import TrainedLifted
from sceneprior.paper.losses import share_of_batch
from sceneprior.paper.prior import ScenePrior
from sceneprior.training.steps import (
    batch_seed,
    check_finite,
    full_precision,
    log_losses,
    with_cosine,
)

ORDERS = 4
"""Number of random object orders over which the likelihood of every val room is averaged."""
TABLES_RATE = 10.0
"""Learning rate of the tables of `Placement` and `PairwisePotentials` relative to that of the rest.
It is high because a pair of classes occurs in only a few batches of an epoch."""
TABLES_DECAY = 10.0
"""Weight decay of these tables relative to that of the rest."""
CONTENTS_RATE = 5.0
"""Learning rate of `Contents` relative to that of the rest. `Contents` is small and independent of
the rest, and has few examples to learn from: only one bedroom in thirty shows that a bedroom may
lack a bed."""

PARTS_OF_OBJECT = ("look", "size", "place")
"""Parts of an object's likelihood given its class."""


class SamplerStage(lightning.LightningModule):
    """Trains by maximum likelihood of rooms, each in a random order of its objects and one of eight
    symmetries."""

    def __init__(
        self,
        prior: ScenePrior,
        latents: nn.Embedding,
        sampler: RoomSampler,
        stage: SamplerConfig,
        val: SamplerRooms | None,
        seed: int,
    ):
        super().__init__()
        self.prior, self.latents = prior.requires_grad_(False), latents.requires_grad_(False)
        self.learner = sampler
        # The best learner so far; this is the network that is loaded from checkpoints.
        self.sampler = copy.deepcopy(sampler).requires_grad_(False)
        self.stage, self.seed = stage, seed
        self.val = val
        self.least: Tensor
        self.register_buffer("least", torch.tensor(math.inf))

    def training_step(self, rooms: PosedRooms, batch_idx: int) -> Tensor:
        """Mean negative log-likelihood of the batch's rooms."""
        generator = torch.Generator().manual_seed(batch_seed(self.seed, self.trainer, batch_idx))
        with full_precision(self.device):
            symmetry = torch.randint(SYMMETRIES, (len(rooms.boxes_m),), generator=generator)
            symmetry = symmetry.to(self.device)
            turned = turned_rooms(rooms, symmetry)
            parts = negative_log_likelihood(self.learner, turned, symmetry, generator)
            taught = rooms.is_object.any(dim=1)
            share = share_of_batch(taught.sum()) / max(int(taught.sum()), 1)
            means = {name: (part * taught).sum() * share for name, part in parts.items()}
            total = torch.stack(list(means.values())).sum()
        check_finite(total, rooms.room_ids)
        log_losses(self, means, total, len(rooms.boxes_m))
        return total

    def val_dataloader(self) -> list[list[int]]:
        """A loader with a single batch, which stands for all val rooms."""
        return [[0]]

    def validation_step(self, batch: Any, batch_idx: int) -> None:
        """Keep the network if the val rooms' likelihood is the highest so far, or without val
        rooms."""
        if self.val is not None:
            found = self.val_loss()
            self.log("val/loss", found, on_step=False, on_epoch=True, batch_size=1)
            if found >= self.least:
                return
            self.least.copy_(found)
        self.sampler.load_state_dict(self.learner.state_dict())

    def on_train_end(self) -> None:
        if self.least.isinf():  # stopped before the first validation, or there are no val rooms
            self.sampler.load_state_dict(self.learner.state_dict())

    def examples(self, trained: TrainedLifted, count: int) -> dict[str, list[Scene]]:
        """Rooms for pictures, `drawn` by the best network so far."""
        names = [f"drawn_{row}" for row in range(count)]
        return {"drawn": sample_scenes(trained, names, 0, None, None, False)}

    @torch.no_grad()
    def val_loss(self) -> Tensor:
        """Mean negative log-likelihood of the val rooms over `ORDERS` orders, which are the same in
        every call."""
        assert self.val is not None
        rooms = self.val.to(self.device).rooms
        generator = torch.Generator().manual_seed(self.seed)
        plain = torch.zeros_like(rooms.object_class[:, 0])
        with full_precision(self.device):
            found = [
                negative_log_likelihood(self.learner, rooms, plain, generator)
                for _ in range(ORDERS)
            ]
        return (
            torch.stack([part.mean() for parts in found for part in parts.values()]).sum() / ORDERS
        )

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        rate = self.stage.learning_rate
        decay = self.stage.weight_decay
        named = list(self.learner.named_parameters())
        contents = [value for name, value in named if name.startswith("contents.")]
        tables = [value for name, value in named if name.endswith("_table")]
        known = {id(value) for value in contents + tables}
        rest = [value for _, value in named if id(value) not in known]
        optimizer = torch.optim.AdamW(
            [
                {"params": rest, "lr": rate},
                {"params": contents, "lr": CONTENTS_RATE * rate},
                {"params": tables, "lr": TABLES_RATE * rate, "weight_decay": TABLES_DECAY * decay},
            ],
            weight_decay=decay,
        )
        return with_cosine(optimizer, int(self.trainer.estimated_stepping_batches))


def negative_log_likelihood(
    sampler: RoomSampler,
    rooms: PosedRooms,
    symmetry: Int[Tensor, " rooms"],
    generator: torch.Generator,
) -> dict[str, Float[Tensor, " rooms"]]:
    """Negative log-likelihood of each room given its rectangle, in parts.

    The parts are the room's list of classes (`class`), and the look, size and place of its objects,
    each given the previous objects and the classes still to come, in a random order. The mean over
    orders is an upper bound of the negative log-likelihood of the set of objects.

    Args:
        symmetry: Symmetry in which each room is presented.
    """
    listed = shuffled(rooms, generator)
    uniform = torch.rand(rooms.is_object.shape, generator=generator).to(rooms.boxes_m)
    rooms = rooms.take(large_first(rooms, sampler.footprints_m2, uniform))
    rectangle_m = frames_of(rooms, generator)
    rooms = replace(rooms, walls_m=None)
    tokens = sampler.tokens(rooms, rectangle_m)
    counts = rooms.is_object.sum(dim=1)
    there = sampler.contents.before(rooms.object_class, rooms.is_object)
    still = there[:, -1:] - there
    zeros = tokens.new_zeros(len(counts))
    found, offers = dict.fromkeys(PARTS_OF_OBJECT, zeros), sampler.offers()
    # One call per step, on the rooms with that many objects, so that nothing is padded. Rooms
    # without objects are read in the first call, since the encoder rejects an empty batch.
    for step in range(max(int(counts.max()), 1)):
        row = (counts.clamp(min=1) > step).nonzero()[:, 0]
        before = _first(rooms, row, step)
        state = sampler.read(
            before, still[row, step], rectangle_m[row], symmetry[row], tokens[row, :step]
        )
        going = (counts[row] > step).nonzero()[:, 0]
        row = row[going]
        following = _first(rooms, row, step + 1).take(torch.full((len(row), 1), step).to(row))
        for name, log_prob in sampler.log_prob(state.rows(going), following, offers).items():
            found[name] = found[name].index_add(0, row, -log_prob)
    listing = sampler.contents.negative_log_likelihood(
        listed.object_class, listed.is_object, rectangle_m[:, 2:]
    )
    return {"class": listing, **found}


def _first(rooms: PosedRooms, row: Int[Tensor, " some"], step: int) -> PosedRooms:
    """The rooms with indices `row`, cut to their first `step` objects."""
    return rooms.changed(lambda part: part[row, :step])

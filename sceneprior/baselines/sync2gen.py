"""The Sync2Gen-style baseline with 3D supervision: a VAE that represents each room as a matrix, and
offsets between pairs of furniture, towards which new rooms are refined.

Source: Yang et al., "Scene Synthesis via Uncertainty-Driven Attribute Synchronization", ICCV 2021.
The refinement is a reduced form of its synchronisation: positions stay near the decoded ones,
within the decoder's mean squared error, and offsets follow their distribution in training rooms.
docs/baselines_3d.md lists our choices and omissions.
"""

from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.baselines.one_stage import BoxConfig, OneStage, OneStageTraining, room_means
from sceneprior.core.settings import Section
from sceneprior.core.views import RoomBoxes
from sceneprior.paper.decoders import mlp
from sceneprior.training.steps import full_precision

COMPONENTS = 64
"""Number of offsets kept per pair of classes; each is the mean of one Gaussian of the pair's
mixture."""
BANDWIDTH_M = 0.15
ANYWHERE = 0.05
"""Weight of a uniform density over `AREA_M2` in each mixture, which bounds the pull of a pair."""
AREA_M2 = 64.0
STEP_M = 0.02
BATCH = 64
"""Rooms per batch in refinement."""


class PairPrior(nn.Module):
    """Gaussian mixtures of the offset between two centres in x and z, one per pair of classes."""

    offsets_m: Tensor
    known: Tensor
    error_m2: Tensor
    """Mean squared error of decoded centres per class, in square metres."""

    def __init__(self, classes: int):
        super().__init__()
        self.register_buffer("offsets_m", torch.zeros(classes, classes, COMPONENTS, 2))
        self.register_buffer("known", torch.zeros(classes, classes, dtype=torch.bool))
        self.register_buffer("error_m2", torch.full((classes,), 0.04))

    def fit(self, rooms: RoomBoxes, seed: int) -> None:
        """Keep `COMPONENTS` offsets per pair of classes from training rooms: a random choice for
        frequent pairs, with repetitions for rare ones."""
        generator = torch.Generator().manual_seed(seed)
        offsets_m, together = _offsets(rooms)
        room, one, other = together.nonzero(as_tuple=True)
        first, second = rooms.object_class[room, one], rooms.object_class[room, other]
        found_m = offsets_m[room, one, other]
        classes = len(self.known)
        pair = first * classes + second
        for index in pair.unique().tolist():
            mine = found_m[pair == index]
            pick = torch.randperm(len(mine), generator=generator)
            pick = pick.repeat(-(-COMPONENTS // len(mine)))[:COMPONENTS]
            self.offsets_m[index // classes, index % classes] = mine[pick]
            self.known[index // classes, index % classes] = True

    def energy(
        self, rooms: RoomBoxes, start_m: Float[Tensor, "rooms objects 2"]
    ) -> Float[Tensor, " rooms"]:
        """Minus the log-posterior of positions, up to a constant:

            sum_i |p_i - start_i|^2 / (2 error_i) - mean_(j != i) log p(p_j - p_i | classes)

        Pairs of classes that occur in no training room are left out.
        """
        error_m2 = self.error_m2[rooms.object_class]
        stray = ((rooms.boxes_m[..., [0, 2]] - start_m) ** 2).sum(dim=-1) / (2 * error_m2)
        offsets_m, together = _offsets(rooms)
        first, second = rooms.object_class.unsqueeze(2), rooms.object_class.unsqueeze(1)
        centres_m = self.offsets_m[first, second]
        squared = ((offsets_m.unsqueeze(-2) - centres_m) ** 2).sum(dim=-1)
        peak = 1 / (2 * torch.pi * BANDWIDTH_M**2)
        density = peak * torch.exp(-squared / (2 * BANDWIDTH_M**2)).mean(dim=-1)
        log_prob = torch.log((1 - ANYWHERE) * density + ANYWHERE / AREA_M2)
        counted = together & self.known[first, second]
        of_pairs = (log_prob * counted).sum(dim=-1) / counted.sum(dim=-1).clamp(min=1)
        return ((stray - of_pairs) * rooms.is_object).sum(dim=-1)

    @torch.enable_grad()
    def refine(self, rooms: RoomBoxes, steps: int) -> RoomBoxes:
        """Reduce the energy by `steps` steps of Adam on the floor positions."""
        moved = []
        for part in rooms.split(BATCH):
            start_m = part.boxes_m[..., [0, 2]]
            part = replace(part, boxes_m=part.boxes_m.clone().requires_grad_())
            # Adam updates each number from its own gradient, so rooms in a batch do not affect each
            # other, and heights and sizes, which have no gradient, do not change.
            optimizer = torch.optim.Adam([part.boxes_m], lr=STEP_M)
            for _ in range(steps):
                optimizer.zero_grad()
                self.energy(part, start_m).sum().backward()
                optimizer.step()
            moved.append(part.boxes_m.detach())
        return replace(rooms, boxes_m=torch.cat(moved))


def _offsets(
    rooms: RoomBoxes,
) -> tuple[Float[Tensor, "rooms objects objects 2"], Bool[Tensor, "rooms objects objects"]]:
    """Offsets from object i to object j in x and z, and True for two objects of a room."""
    floor_m = rooms.boxes_m[..., [0, 2]]
    objects = floor_m.shape[1]
    other = ~torch.eye(objects, dtype=torch.bool, device=floor_m.device)
    together = rooms.is_object.unsqueeze(2) & rooms.is_object.unsqueeze(1) & other
    return floor_m.unsqueeze(1) - floor_m.unsqueeze(2), together


ATTRIBUTES = 7
"""Number of attributes of a slot: existence, centre x, y, z, full extents along x, y, z."""
READS = 4
"""Number of input groups connected to each output of a sparse layer."""
HIDDEN_GROUP = 8
MOMENTUM = 0.05
"""Weight of the newest batch in the running error of each class."""
LEAST_SPREAD_M = 0.05
LEAST_SIZE_M = 0.02


class Sync2genModel(Section):
    """Size of the network; `latent` is the released setting."""

    width: int = Field(512, ge=8)
    """Width of the hidden layers; a multiple of 8."""
    latent: int = Field(20, ge=1)
    """Size of a room's latent."""
    slots: int = Field(8, ge=1, le=1000)
    """Maximum number of objects of one class in a room (released code: 4). Further objects are left
    out; `train/left_out` logs their share."""
    refine_steps: int = Field(100, ge=0)
    """Gradient steps that move each new room's objects towards the offsets of training rooms; 0
    keeps rooms as decoded (the paper's Sync2Gen*). Training does not use it."""

    @model_validator(mode="after")
    def _width_in_groups(self) -> "Sync2genModel":
        if self.width % HIDDEN_GROUP:
            raise ValueError(f"width {self.width} is not a multiple of {HIDDEN_GROUP}")
        return self


class Sync2Gen(nn.Module):
    """A variational auto-encoder of rooms.

    A room is a matrix with `slots` slots per class; each slot holds the attributes of one object,
    standardised per class, or is empty. Objects of a class fill its slots in order of x, then z;
    those beyond the last slot are left out. Sparse and dense layers alternate, which reduces
    overfitting. `seed` chooses the connections of sparse layers and the offsets that `PairPrior`
    keeps. `classes` is the size of the label set with void.
    """

    mean_m: Tensor
    spread_m: Tensor

    def __init__(self, config: Sync2genModel, classes: int, seed: int):
        super().__init__()
        slots, width, latent = config.slots, config.width, config.latent
        self.classes, self.slots, self.latent = classes, slots, latent
        self.refine_steps, self.seed = config.refine_steps, seed
        cells = (classes - 1) * slots * ATTRIBUTES
        self.register_buffer("mean_m", torch.zeros(classes - 1, 1, 6))
        self.register_buffer("spread_m", torch.ones(classes - 1, 1, 6))
        self.pairs = PairPrior(classes)
        self.encoder = mlp(
            SparseLinear(cells, width, ATTRIBUTES, seed),
            nn.Linear(width, width),
            SparseLinear(width, width, HIDDEN_GROUP, seed + 1),
            nn.Linear(width, 2 * latent),
        )
        self.decoder = mlp(
            nn.Linear(latent, width),
            SparseLinear(width, width, HIDDEN_GROUP, seed + 2),
            nn.Linear(width, width),
            nn.Linear(width, cells),
        )

    def fit_statistics(self, rooms: RoomBoxes) -> None:
        """Compute each class's means and standard deviations, and the offsets of class pairs, from
        training rooms."""
        for label in range(1, self.classes):
            mine = rooms.boxes_m[rooms.is_object & (rooms.object_class == label)]
            if len(mine):
                spread_m = mine.std(dim=0, correction=0)
                self.mean_m[label - 1, 0] = mine.mean(dim=0)
                self.spread_m[label - 1, 0] = spread_m.clamp(min=LEAST_SPREAD_M)
        self.pairs.fit(rooms, self.seed)

    def to_matrix(self, rooms: RoomBoxes) -> Float[Tensor, "rooms classes slots 7"]:
        """Convert rooms to matrices, which are bit-identical for any order of the objects."""
        label = rooms.object_class.where(rooms.is_object, self.classes)
        order = torch.arange(label.shape[1], device=label.device).expand_as(label)
        # The sort is stable, so the last key is the primary one.
        for key in (rooms.boxes_m[..., 2], rooms.boxes_m[..., 0], label):
            order = order.gather(1, key.gather(1, order).argsort(dim=1, stable=True))
        rooms, label = rooms.take(order), label.gather(1, order).contiguous()
        rank = torch.arange(label.shape[1], device=label.device) - torch.searchsorted(label, label)
        fits = (label < self.classes) & (rank < self.slots)
        row = (label - 1).clamp(max=self.classes - 2)
        unit = (rooms.boxes_m - self.mean_m[row, 0]) / self.spread_m[row, 0]
        cell = torch.cat([torch.ones_like(unit[..., :1]), unit], dim=-1)
        # Objects without a slot go to an extra slot after the last, which is cut off below.
        last = (self.classes - 1) * self.slots
        slot = (row * self.slots + rank).where(fits, last)
        matrix = cell.new_zeros(len(label), last + 1, ATTRIBUTES)
        matrix = matrix.scatter(1, slot.unsqueeze(-1).expand_as(cell), cell)
        return matrix[:, :last].unflatten(1, (self.classes - 1, self.slots))

    def encode(
        self, matrix: Float[Tensor, "rooms classes slots 7"]
    ) -> tuple[Float[Tensor, "rooms latent"], Float[Tensor, "rooms latent"]]:
        """Mean and log-variance of each room's latent."""
        mean, log_variance = self.encoder(matrix.flatten(1)).chunk(2, dim=-1)
        return mean, log_variance.clamp(-10, 10)

    def decode(self, z: Float[Tensor, "rooms latent"]) -> Float[Tensor, "rooms classes slots 7"]:
        """Decode latents to matrices whose first attribute is the logit of a slot's existence."""
        return self.decoder(z).unflatten(-1, (self.classes - 1, self.slots, ATTRIBUTES))

    @torch.no_grad()
    def sample(self, count: int, seed: int) -> RoomBoxes:
        """New rooms, from latents of N(0, 1). The first rooms of a seed do not depend on
        `count`."""
        generator = torch.Generator().manual_seed(seed)
        z = torch.stack([torch.randn(self.latent, generator=generator) for _ in range(count)])
        rooms = self.to_rooms(self.decode(z.to(self.mean_m)))
        return self.pairs.refine(rooms, self.refine_steps)

    def to_rooms(self, decoded: Float[Tensor, "rooms classes slots 7"]) -> RoomBoxes:
        """Boxes in metres of the slots whose probability of existence is above 0.5."""
        boxes_m = (self.mean_m + self.spread_m * decoded[..., 1:]).flatten(1, 2)
        boxes_m = torch.cat([boxes_m[..., :3], boxes_m[..., 3:].clamp(min=LEAST_SIZE_M)], dim=-1)
        exists = (decoded[..., 0] > 0).flatten(1, 2)
        label = 1 + torch.arange(exists.shape[1], device=exists.device) // self.slots
        widest = max(int(exists.sum(dim=1).max()), 1)
        first = (~exists).long().argsort(dim=1, stable=True)[:, :widest]
        return RoomBoxes(label * exists, exists, boxes_m).take(first)


class SparseLinear(nn.Linear):
    """A linear layer with `READS` groups of neighbouring inputs per output."""

    mask: Tensor

    def __init__(self, inputs: int, outputs: int, group: int, seed: int):
        super().__init__(inputs, outputs)
        groups = inputs // group
        reads = min(READS, groups)
        generator = torch.Generator().manual_seed(seed)
        seen = torch.rand(outputs, groups, generator=generator).argsort(dim=1) < reads
        self.register_buffer("mask", seen.repeat_interleave(group, dim=1).float())
        with torch.no_grad():  # the usual initial scale for this number of connected inputs
            self.weight.mul_((groups / reads) ** 0.5)

    def forward(self, x: Float[Tensor, "*batch inputs"]) -> Float[Tensor, "*batch outputs"]:
        """The layer's output, with the weights of missing connections at 0."""
        return F.linear(x, self.weight * self.mask, self.bias)


class Sync2genTraining(OneStageTraining):
    """The released epochs, batch size and learning rate."""

    epochs: int = Field(800, ge=1)
    batch_size: int = Field(64, ge=1)
    learning_rate: float = Field(1e-3, gt=0)
    kl_weight: float = Field(0.1, ge=0)
    """Weight of the KL divergence from N(0, 1). A larger weight makes new rooms better but less
    varied; a smaller one reconstructs training rooms better, but makes new rooms worse."""

    def weight_of(self, loss: str) -> float:
        return self.kl_weight if loss == "kl" else 1.0


class Sync2genConfig(BoxConfig):
    """Config of a run of the Sync2Gen-style VAE."""

    method: Literal["sync2gen"] = "sync2gen"
    model: Sync2genModel = Sync2genModel()
    training: Sync2genTraining = Sync2genTraining()

    def make(self) -> "Sync2genStage":
        return Sync2genStage(Sync2Gen(self.model, self.classes, self.seed), self)


class Sync2genStage(OneStage):
    """Minimises reconstruction errors and the KL divergence of latents from N(0, 1)."""

    prior: Sync2Gen

    def training_step(self, rooms: RoomBoxes, batch_idx: int) -> Tensor:
        matrix = self.prior.to_matrix(rooms)
        mean, log_variance = self.prior.encode(matrix)
        # `StepSeed` seeds this noise by the step, so that a resumed run draws the same.
        z = mean + torch.exp(0.5 * log_variance) * torch.randn_like(mean)
        decoded = self.prior.decode(z)
        with full_precision(self.device):
            decoded, mean, log_variance = decoded.float(), mean.float(), log_variance.float()
            # Existence is compared in all slots, other attributes in filled slots.
            exists = matrix[..., 0]
            off = F.smooth_l1_loss(decoded[..., 1:], matrix[..., 1:], reduction="none")
            off = off * exists.unsqueeze(-1)
            entropy = F.binary_cross_entropy_with_logits(decoded[..., 0], exists, reduction="none")
            losses = {
                "existence": entropy.sum(dim=(1, 2)),
                "position": off[..., :3].sum(dim=(1, 2, 3)),
                "size": off[..., 3:].sum(dim=(1, 2, 3)),
                "kl": 0.5 * (mean**2 + log_variance.exp() - 1 - log_variance).sum(dim=-1),
            }
            # Running errors of decoded centres, which refinement uses.
            off_m = (decoded.detach() - matrix)[..., [1, 3]] * self.prior.spread_m[..., [0, 2]]
            count = exists.sum(dim=(0, 2))
            squared = ((off_m**2).mean(dim=-1) * exists).sum(dim=(0, 2))
            known = self.prior.pairs.error_m2[1:]
            known += MOMENTUM * (count > 0) * (squared / count.clamp(min=1) - known)
            objects = rooms.is_object.sum()
            left_out = (objects - exists.sum()) / objects.clamp(min=1)
            return self.total(room_means(losses, rooms), rooms, left_out=left_out)

"""The network of the Sync2Gen-style baseline: a VAE that represents each room as a matrix.

Source: Yang et al., "Scene Synthesis via Uncertainty-Driven Attribute Synchronization", ICCV 2021;
docs/baselines_3d.md lists our choices where the paper is ambiguous.
"""

import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.baselines.sync2gen.pairs import PairPrior
from sceneprior.core.settings import Section
from sceneprior.core.views import RoomBoxes
from sceneprior.paper.layers import mlp

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

    def losses(
        self,
        matrix: Float[Tensor, "rooms classes slots 7"],
        decoded: Float[Tensor, "rooms classes slots 7"],
        mean: Float[Tensor, "rooms latent"],
        log_variance: Float[Tensor, "rooms latent"],
    ) -> dict[str, Float[Tensor, " rooms"]]:
        """Losses of each room: existence over all slots, other attributes over filled slots."""
        exists = matrix[..., 0]
        off = F.smooth_l1_loss(decoded[..., 1:], matrix[..., 1:], reduction="none")
        off = off * exists.unsqueeze(-1)
        existence = F.binary_cross_entropy_with_logits(decoded[..., 0], exists, reduction="none")
        return {
            "existence": existence.sum(dim=(1, 2)),
            "position": off[..., :3].sum(dim=(1, 2, 3)),
            "size": off[..., 3:].sum(dim=(1, 2, 3)),
            "kl": 0.5 * (mean**2 + log_variance.exp() - 1 - log_variance).sum(dim=-1),
        }

    @torch.no_grad()
    def note_errors(
        self,
        matrix: Float[Tensor, "rooms classes slots 7"],
        decoded: Float[Tensor, "rooms classes slots 7"],
    ) -> None:
        """Update the running errors of decoded centres, which refinement uses."""
        off_m = (decoded - matrix)[..., [1, 3]] * self.spread_m[..., [0, 2]]
        squared = (off_m**2).mean(dim=-1) * matrix[..., 0]
        count = matrix[..., 0].sum(dim=(0, 2))
        newest = squared.sum(dim=(0, 2)) / count.clamp(min=1)
        known = self.pairs.error_m2[1:]
        known += MOMENTUM * (count > 0) * (newest - known)

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

"""ATISS with 3D supervision: the distribution of the next box, given the boxes placed so far.

Source: Paschalidou et al., "ATISS: Autoregressive Transformers for Indoor Scene Synthesis", NeurIPS
2021; docs/baselines_3d.md names the differences."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.baselines.decoders import EncoderConfig
from sceneprior.baselines.one_stage import BoxConfig, OneStage, OneStageTraining, room_means
from sceneprior.core.mixtures import draw_index
from sceneprior.core.settings import AttentionSection
from sceneprior.core.views import RoomBoxes
from sceneprior.paper.decoders import mlp
from sceneprior.training.steps import batch_seed, full_precision

LEVELS = 256
"""Number of steps into which [-1, 1] is divided. The probability of a step is at most 1, whereas a
continuous density could grow without bound where many rooms share a value."""
HALF_STEP = 1 / (LEVELS - 1)
LEAST_LOG_SCALE = -7.0
"""Minimum log-scale; at this scale, a logistic already lies within one step."""


@dataclass(frozen=True)
class LogisticMixture:
    """A mixture of K weighted logistics for each number."""

    weight_logits: Float[Tensor, "*batch mixtures"]
    means: Float[Tensor, "*batch mixtures"]
    log_scales: Float[Tensor, "*batch mixtures"]

    @classmethod
    def of(cls, features: Float[Tensor, "*batch triples"]) -> "LogisticMixture":
        """Build the mixture from a network's output, 3 K features per number."""
        weight_logits, means, log_scales = features.chunk(3, dim=-1)
        return cls(weight_logits, means, log_scales.clamp(min=LEAST_LOG_SCALE))

    def log_prob(self, values: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Log-probability of the step around each value. The outermost steps extend to infinity, so
        that all steps together have probability 1.

        The probability of a step with scaled ends a > b is

            sigmoid(a) - sigmoid(b) = sigmoid(a) * sigmoid(-b) * (1 - exp(b - a)),

        and the logarithm of the right side is accurate for all a and b.
        """
        offset = values.unsqueeze(-1) - self.means
        inverse = torch.exp(-self.log_scales)
        below_upper = F.logsigmoid((offset + HALF_STEP) * inverse)
        above_lower = F.logsigmoid((HALF_STEP - offset) * inverse)
        inside = below_upper + above_lower + torch.log(-torch.expm1(-2 * HALF_STEP * inverse))
        value = values.unsqueeze(-1)
        first, last = value < HALF_STEP - 1, value > 1 - HALF_STEP
        of_each = torch.where(first, below_upper, torch.where(last, above_lower, inside))
        return torch.logsumexp(self.weight_logits.log_softmax(dim=-1) + of_each, dim=-1)

    def draw(
        self, choice: Float[Tensor, "*batch"], place: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Samples in [-1, 1] from uniform numbers: `choice` selects the logistic, and `place` the
        quantile within it."""
        chosen = draw_index(self.weight_logits, choice).unsqueeze(-1)
        mean = self.means.gather(-1, chosen)[..., 0]
        scale = self.log_scales.gather(-1, chosen)[..., 0].exp()
        return (mean + scale * torch.logit(place, eps=1e-6)).clamp(-1, 1)


END = 0
"""Class that ends a room: void, which no piece of furniture has."""
PARTS = {"position": (0, 3), "angle": (3, 4), "size": (4, 7)}
"""The parts of an object's seven numbers, in the order in which they are sampled."""
CUT_RAD = -3 * math.pi / 4
"""Yaw that is encoded as -1 and as 1: a diagonal, because few pieces of furniture face one."""
CLASS_WIDTH = 64
OCTAVES = 8
"""Number of frequencies of `fourier_features`. The highest has a period of two steps of the
mixture; the published 32 octaves exceed the precision of float32."""
BATCH = 256
"""Rooms per batch in sampling."""


class SetModel(EncoderConfig, AttentionSection):
    """Size of a network that generates sets of objects: ATISS or the set flow."""

    max_objects: int = Field(ge=1, le=1000)
    """Maximum number of objects in a sampled room."""
    width: int = Field(512, ge=8)
    """Width of the encoder and of the hidden layers."""


class AtissModel(SetModel):
    """Size of the network; the defaults are the published settings."""

    mixtures: int = Field(10, ge=1)
    """K, the number of logistics in the mixture of each number."""


class Atiss(nn.Module):
    """Generates objects one after the other, each given the set of objects before it.

    A transformer encoder without positional encoding reads the placed objects and one learnt query.
    Its output at the query predicts the class of the next object or the room's end, then its
    position given the class, then its angle, then its size, each given all before it. Every number
    has its own mixture of logistics. An object is seven numbers in [-1, 1]: centre, yaw and
    extents. `classes` is the size of the label set with void.
    """

    low_m: Tensor
    high_m: Tensor

    def __init__(self, config: AtissModel, classes: int):
        super().__init__()
        width = config.width
        self.max_objects = config.max_objects
        self.register_buffer("low_m", torch.zeros(6))
        self.register_buffer("high_m", torch.ones(6))
        self.class_embedding = nn.Embedding(classes, CLASS_WIDTH)
        self.object = nn.Linear(CLASS_WIDTH + 7 * 2 * OCTAVES, width)
        self.query = nn.Parameter(torch.randn(width))
        self.encoder = config.build_layers(width)
        self.class_head = _head(width, classes)
        known = width + CLASS_WIDTH
        self.heads = nn.ModuleDict(
            {
                name: _head(known + start * 2 * OCTAVES, (end - start) * 3 * config.mixtures)
                for name, (start, end) in PARTS.items()
            }
        )

    def fit_statistics(self, rooms: RoomBoxes) -> None:
        """Set the range of every coordinate and size from the training rooms."""
        boxes_m = rooms.boxes_m[rooms.is_object]
        self.low_m.copy_(boxes_m.amin(dim=0))
        # A number that is the same in all rooms would have a range of 0.
        self.high_m.copy_(torch.maximum(boxes_m.amax(dim=0), self.low_m + 1e-3))

    def to_unit(self, rooms: RoomBoxes) -> Float[Tensor, "rooms objects 7"]:
        """The seven numbers of each object, from metres and radians."""
        assert rooms.yaw_rad is not None, "true boxes have yaws"
        unit = 2 * (rooms.boxes_m - self.low_m) / (self.high_m - self.low_m) - 1
        turn = torch.remainder(rooms.yaw_rad[..., None] - CUT_RAD, 2 * math.pi) / math.pi - 1
        return torch.cat([unit[..., :3], turn, unit[..., 3:]], dim=-1)

    def to_metres(
        self, unit: Float[Tensor, "*batch 7"]
    ) -> tuple[Float[Tensor, "*batch 6"], Float[Tensor, "*batch"]]:
        """Boxes in metres and yaws in radians, from the seven numbers of each object."""
        boxes = torch.cat([unit[..., :3], unit[..., 4:]], dim=-1)
        boxes_m = self.low_m + (boxes + 1) / 2 * (self.high_m - self.low_m)
        turn = (unit[..., 3] + 1) * math.pi + CUT_RAD
        return boxes_m, torch.remainder(turn + math.pi, 2 * math.pi) - math.pi

    def context(
        self,
        object_class: Int[Tensor, "rooms objects"],
        unit: Float[Tensor, "rooms objects 7"],
        is_object: Bool[Tensor, "rooms objects"],
    ) -> Float[Tensor, "rooms width"]:
        """The encoder's output at the query; it does not depend on the order of the objects."""
        objects = torch.cat([self.class_embedding(object_class), fourier_features(unit)], dim=-1)
        query = self.query.expand(len(unit), 1, -1)
        tokens = torch.cat([query, self.object(objects)], dim=1)
        padding = torch.cat([is_object.new_zeros(len(unit), 1), ~is_object], dim=1)
        for layer in self.encoder:
            tokens = layer(tokens, src_key_padding_mask=padding)
        return tokens[:, 0]

    def log_prob(
        self,
        context: Float[Tensor, "rooms width"],
        next_class: Int[Tensor, " rooms"],
        next_unit: Float[Tensor, "rooms 7"],
    ) -> dict[str, Float[Tensor, " rooms"]]:
        """Log-probabilities of the next object's class, position, angle and size; all but the first
        are 0 at the class `END`."""
        class_log_prob = self.class_head(context).log_softmax(dim=-1)
        found = {"class": class_log_prob.gather(-1, next_class[:, None])[:, 0]}
        for name, (start, end) in PARTS.items():
            mixture = self._mixture(name, context, next_class, next_unit)
            log_prob = mixture.log_prob(next_unit[:, start:end]).sum(dim=-1)
            found[name] = log_prob * (next_class != END)
        return found

    def _mixture(self, name: str, context: Tensor, label: Tensor, unit: Tensor) -> LogisticMixture:
        """The mixture of one of `PARTS`, given the class and the earlier parts of `unit`."""
        start, end = PARTS[name]
        known = [context, self.class_embedding(label), fourier_features(unit[:, :start])]
        features = self.heads[name](torch.cat(known, dim=-1))
        return LogisticMixture.of(features.unflatten(-1, (end - start, -1)))

    @torch.no_grad()
    def sample(self, count: int, seed: int) -> RoomBoxes:
        """New rooms. The first rooms of a seed do not depend on `count`."""
        generator = torch.Generator().manual_seed(seed)
        uniform = torch.rand(count, self.max_objects, 15, generator=generator)
        parts = [self._sample(part) for part in uniform.to(self.query.device).split(BATCH)]
        labels, unit = (torch.cat(part) for part in zip(*parts, strict=True))
        boxes_m, yaw_rad = self.to_metres(unit)
        return RoomBoxes(labels, labels != END, boxes_m, yaw_rad=yaw_rad)

    def _sample(
        self, uniform: Float[Tensor, "rooms objects 15"]
    ) -> tuple[Int[Tensor, "rooms objects"], Float[Tensor, "rooms objects 7"]]:
        """Classes, which are `END` from a room's end on, and the seven numbers of each object."""
        labels = torch.full(uniform.shape[:2], END, device=uniform.device)
        unit = uniform.new_zeros(*labels.shape, 7)
        going = torch.ones_like(labels[:, 0], dtype=torch.bool)
        for step in range(self.max_objects):
            before = labels[:, :step]
            context = self.context(before, unit[:, :step], before != END)
            drawn, choice, place = uniform[:, step].split([1, 7, 7], dim=-1)
            label = draw_index(self.class_head(context), drawn[:, 0])
            going = going & (label != END)
            for name, (start, end) in PARTS.items():
                mixture = self._mixture(name, context, label, unit[:, step])
                unit[:, step, start:end] = mixture.draw(choice[:, start:end], place[:, start:end])
            labels[:, step] = label.where(going, END)
        return labels, unit


def fourier_features(unit: Float[Tensor, "*batch numbers"]) -> Float[Tensor, "*batch features"]:
    """Sines, then cosines, of each number in [-1, 1] at `OCTAVES` frequencies."""
    octaves = math.pi * 2.0 ** torch.arange(OCTAVES, device=unit.device, dtype=unit.dtype)
    phase = (unit.unsqueeze(-1) * octaves).flatten(-2)
    return torch.cat([phase.sin(), phase.cos()], dim=-1)


def _head(inputs: int, outputs: int) -> nn.Sequential:
    return mlp(nn.Linear(inputs, inputs), nn.Linear(inputs, outputs))


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
        return AtissStage(Atiss(self.model, self.classes), self)


class AtissStage(OneStage):
    """Maximises the likelihood of one object of each room, given some of the others."""

    prior: Atiss

    def training_step(self, rooms: RoomBoxes, batch_idx: int) -> Tensor:
        placed, coming = part_of_rooms(rooms, batch_seed(self.seed, self.trainer, batch_idx))
        unit, next_unit = self.prior.to_unit(placed), self.prior.to_unit(coming)
        context = self.prior.context(placed.object_class, unit, placed.is_object)
        with full_precision(self.device):
            next_class = coming.object_class[:, 0]
            log_probs = self.prior.log_prob(context.float(), next_class, next_unit[:, 0])
            losses = {name: -log_prob for name, log_prob in log_probs.items()}
            return self.total(room_means(losses, rooms), rooms)


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

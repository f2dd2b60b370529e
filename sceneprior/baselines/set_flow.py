"""The set flow with 3D supervision: it turns noise into all objects of a room at the same time.

Sources: Tang et al., "DiffuScene: Denoising Diffusion Models for Generative Indoor Scene
Synthesis", CVPR 2024 (a room as a set of tokens that a network denoises); Lipman et al., "Flow
Matching for Generative Modeling", ICLR 2023 (the loss and the differential equation).
docs/baselines_3d.md names the differences."""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.baselines.atiss import BATCH, OCTAVES, SetModel, fourier_features
from sceneprior.baselines.one_stage import BoxConfig, OneStage, OneStageTraining, room_means
from sceneprior.core.mixtures import draw_index
from sceneprior.core.views import RoomBoxes
from sceneprior.paper.decoders import mlp
from sceneprior.paper.matching import assign
from sceneprior.training.steps import full_precision

NUMBERS = 8
"""Number of continuous values at the start of a token: centre, log extents, cosine and sine of yaw.
"""
PARTS = {"position": slice(0, 3), "size": slice(3, 6), "angle": slice(6, 8)}
"""Slices of the continuous values; the loss of each is logged separately."""
WAVE = 4.0
"""Half the period of the slowest Fourier feature, in standard deviations of a value."""
LEAST_SPREAD = 1e-3
"""Minimum standard deviation by which values are divided."""


class SetFlowModel(SetModel):
    """Size of the network."""

    class_scale: float = Field(2.0, gt=0)
    """Value of a one-hot class, in standard deviations of the noise. With a larger value, sampling
    decides the class of an object before its position."""
    steps: int = Field(100, ge=1)
    """Steps of Euler's method from noise to a room."""


class SetFlow(nn.Module):
    """A transformer without positional encoding that predicts velocities from noise to rooms.

    A room is a set of tokens, each `NUMBERS` standardised values followed by a scaled one-hot
    class. The number of objects is sampled first, from its distribution in the training rooms.
    `classes` is the size of the label set with void.
    """

    mean: Tensor
    spread: Tensor
    counts: Tensor
    """Number of training rooms with each number of objects."""

    def __init__(self, config: SetFlowModel, classes: int):
        super().__init__()
        self.max_objects, self.steps = config.max_objects, config.steps
        self.class_scale, self.classes = config.class_scale, classes
        self.register_buffer("mean", torch.zeros(NUMBERS))
        self.register_buffer("spread", torch.ones(NUMBERS))
        self.register_buffer("counts", torch.ones(config.max_objects + 1))
        width, token = config.width, NUMBERS + classes - 1
        self.object = nn.Linear(token + NUMBERS * 2 * OCTAVES, width)
        self.time = mlp(nn.Linear(2 * OCTAVES, width), nn.Linear(width, width))
        self.blocks = nn.ModuleList(
            Block(width, config.heads, config.hidden, config.dropout) for _ in range(config.layers)
        )
        self.out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, token))

    def fit_statistics(self, rooms: RoomBoxes) -> None:
        """Set the means and standard deviations of values, and the histogram of object counts."""
        numbers = _numbers(rooms)[rooms.is_object]
        self.mean.copy_(numbers.mean(dim=0))
        # A value that is the same in all rooms would have a standard deviation of 0.
        self.spread.copy_(numbers.std(dim=0, correction=0).clamp(min=LEAST_SPREAD))
        self.counts.copy_(torch.bincount(rooms.is_object.sum(dim=1), minlength=len(self.counts)))

    def to_tokens(self, rooms: RoomBoxes) -> Float[Tensor, "rooms objects token"]:
        """The tokens of rooms; the values of padding tokens are undefined."""
        one_hot = F.one_hot(rooms.object_class, self.classes)[..., 1:]
        unit = (_numbers(rooms) - self.mean) / self.spread
        return torch.cat([unit, self.class_scale * one_hot], dim=-1)

    def to_rooms(
        self, tokens: Float[Tensor, "rooms objects token"], is_object: Bool[Tensor, "rooms objects"]
    ) -> RoomBoxes:
        """The rooms that tokens describe: each object has the class with the largest value."""
        numbers = self.mean + self.spread * tokens[..., :NUMBERS]
        centers_m, log_sizes, cosine, sine = numbers.split([3, 3, 1, 1], dim=-1)
        return RoomBoxes(
            object_class=(1 + tokens[..., NUMBERS:].argmax(dim=-1)) * is_object,
            is_object=is_object,
            boxes_m=torch.cat([centers_m, log_sizes.exp()], dim=-1),
            yaw_rad=torch.atan2(sine, cosine)[..., 0],
        )

    def predict(
        self,
        tokens: Float[Tensor, "rooms objects token"],
        time: Float[Tensor, " rooms"],
        is_object: Bool[Tensor, "rooms objects"],
    ) -> tuple[Float[Tensor, "rooms objects 8"], Float[Tensor, "rooms objects furniture"]]:
        """Velocity of the continuous values of each token at `time`, from 0 (noise) to 1 (a room),
        and logits of the token's final class; both are 0 for padding."""
        # Half of a batch is padding, so all layers but attention run on the objects alone.
        here, counts = tokens[is_object], is_object.sum(dim=1)
        numbers = here[:, :NUMBERS]
        known = self.time(fourier_features(time.unsqueeze(-1))).repeat_interleave(counts, dim=0)
        hidden = known + self.object(torch.cat([here, fourier_features(numbers / WAVE)], dim=-1))
        for block in self.blocks:
            hidden = block(hidden, is_object)
        change, logits = self.out(hidden).split([NUMBERS, self.classes - 1], dim=-1)
        # The best linear estimate of the velocity of standardised values, plus the predicted
        # residual in units of the residual's standard deviation.
        late = time.repeat_interleave(counts).unsqueeze(-1)
        variance = late**2 + (1 - late) ** 2
        velocity = (2 * late - 1) / variance * numbers + change / variance.sqrt()
        return _padded(velocity, is_object), _padded(logits, is_object)

    def velocity(
        self,
        tokens: Float[Tensor, "rooms objects token"],
        time: Float[Tensor, " rooms"],
        is_object: Bool[Tensor, "rooms objects"],
    ) -> Float[Tensor, "rooms objects token"]:
        """Velocity of each token at a `time` below 1. The class moves on a straight line to its
        predicted mean."""
        velocity, logits = self.predict(tokens, time, is_object)
        target = self.class_scale * logits.softmax(dim=-1)
        left = (1 - time)[:, None, None]
        return torch.cat([velocity, (target - tokens[..., NUMBERS:]) / left], dim=-1)

    @torch.no_grad()
    def sample(self, count: int, seed: int) -> RoomBoxes:
        """Sample rooms. The first rooms of a seed do not depend on `count`."""
        generator = torch.Generator().manual_seed(seed)
        shape = self.max_objects, NUMBERS + self.classes - 1
        choices, noise = [], []
        for _ in range(count):
            choices.append(torch.rand((), generator=generator))
            noise.append(torch.randn(shape, generator=generator))
        logits = self.counts.log().expand(count, -1)
        objects = draw_index(logits, torch.stack(choices).to(self.counts))
        is_object = torch.arange(self.max_objects, device=objects.device) < objects[:, None]
        tokens = torch.stack(noise).to(self.counts)
        parts = zip(tokens.split(BATCH), is_object.split(BATCH), strict=True)
        return self.to_rooms(torch.cat([self._integrate(*part) for part in parts]), is_object)

    def _integrate(self, tokens: Tensor, is_object: Tensor) -> Tensor:
        """Integrate the velocities from time 0 to 1 with Euler's method."""
        for step in range(self.steps):
            time = tokens.new_full(tokens.shape[:1], step / self.steps)
            tokens = tokens + self.velocity(tokens, time, is_object) / self.steps
        return tokens


class Block(nn.Module):
    """Attention among the objects of each room, then a feed-forward layer, each after a layer
    norm and with dropout."""

    def __init__(self, width: int, heads: int, hidden: int, dropout: float):
        super().__init__()
        self.heads, self.drop = heads, nn.Dropout(dropout)
        self.before_attention, self.before_mlp = nn.LayerNorm(width), nn.LayerNorm(width)
        self.queries_keys_values = nn.Linear(width, 3 * width)
        self.mix = nn.Linear(width, width)
        self.mlp = mlp(nn.Linear(width, hidden), nn.Linear(hidden, width))

    def forward(
        self, hidden: Float[Tensor, "all width"], is_object: Bool[Tensor, "rooms objects"]
    ) -> Float[Tensor, "all width"]:
        """Apply the block to the features of all objects of a batch, room by room."""
        projected = _padded(self.queries_keys_values(self.before_attention(hidden)), is_object)
        query, key, value = projected.unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        seen = F.scaled_dot_product_attention(query, key, value, is_object[:, None, None])
        hidden = hidden + self.drop(self.mix(seen.transpose(1, 2).flatten(-2)[is_object]))
        return hidden + self.drop(self.mlp(self.before_mlp(hidden)))


def _padded(
    values: Float[Tensor, "all numbers"], is_object: Bool[Tensor, "rooms objects"]
) -> Float[Tensor, "rooms objects numbers"]:
    """The features of all objects, arranged by room and padded with zeros."""
    padded = values.new_zeros(*is_object.shape, values.shape[-1])
    padded[is_object] = values
    return padded


def _numbers(rooms: RoomBoxes) -> Float[Tensor, "rooms objects 8"]:
    """Centre, log extents, cosine and sine of the yaw of each object."""
    assert rooms.yaw_rad is not None, "true boxes have yaws"
    centers_m, sizes_m = rooms.boxes_m.split(3, dim=-1)
    front = torch.stack([rooms.yaw_rad.cos(), rooms.yaw_rad.sin()], dim=-1)
    # Padding has boxes of size 0.
    log_sizes = torch.where(rooms.is_object[..., None], sizes_m, 1.0).log()
    return torch.cat([centers_m, log_sizes, front], dim=-1)


class SetFlowTraining(OneStageTraining):
    """Training settings of the set flow."""

    epochs: int = Field(500, ge=1)
    batch_size: int = Field(64, ge=1)
    learning_rate: float = Field(1e-3, gt=0)


class SetFlowConfig(BoxConfig):
    """Config of a run of the set flow."""

    method: Literal["set_flow"] = "set_flow"
    model: SetFlowModel
    training: SetFlowTraining = SetFlowTraining()

    def make(self) -> "SetFlowStage":
        return SetFlowStage(SetFlow(self.model, self.classes), self)


class SetFlowStage(OneStage):
    """Training by flow matching. The loss of a room sums, over its objects, half the squared error
    of the velocity from noise to the training room, and the cross-entropy of the class."""

    prior: SetFlow

    def training_step(self, rooms: RoomBoxes, batch_idx: int) -> Tensor:
        is_object = rooms.is_object
        tokens = self.prior.to_tokens(rooms)
        # `StepSeed` seeds noise and times by the step, so that a resumed run draws the same ones.
        noise = matched(torch.randn_like(tokens), tokens, is_object)
        time = torch.rand_like(tokens[:, 0, 0])
        between = torch.lerp(noise, tokens, time[:, None, None])
        velocity, logits = self.prior.predict(between, time, is_object)
        with full_precision(self.device):
            halved = (velocity.float() - (tokens - noise)[..., :NUMBERS]) ** 2 / 2
            halved = halved * is_object.unsqueeze(-1)
            losses = {name: halved[..., part].sum(dim=(1, 2)) for name, part in PARTS.items()}
            true = (rooms.object_class - 1).clamp(min=0).unsqueeze(-1)
            entropy = -logits.float().log_softmax(dim=-1).gather(-1, true)[..., 0]
            losses["class"] = (entropy * is_object).sum(dim=1)
            return self.total(room_means(losses, rooms), rooms)


def matched(
    noise: Float[Tensor, "rooms objects token"],
    tokens: Float[Tensor, "rooms objects token"],
    is_object: Bool[Tensor, "rooms objects"],
) -> Float[Tensor, "rooms objects token"]:
    """Reorder the noise of each room so that the summed squared distance to the objects is minimal.

    Rooms are sets, so that any order of the noise is a valid start, and straight paths that do not
    cross are learnt faster (Song et al., "Equivariant Flow Matching with Hybrid Probability
    Transport", NeurIPS 2023).
    """
    counts = is_object.sum(dim=1).tolist()
    order = assign(torch.cdist(noise, tokens) ** 2, counts, counts)
    return torch.take_along_dim(noise, order.unsqueeze(-1), dim=1)

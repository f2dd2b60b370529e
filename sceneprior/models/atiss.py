"""Placed boxes in, the next box's distribution out: the ATISS baseline, which learns from 3D.

Source: Paschalidou et al., "ATISS: Autoregressive Transformers for Indoor Scene Synthesis", NeurIPS
2021. Where we differ: docs/baselines_3d.md.
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from sceneprior.batches import RoomBoxes
from sceneprior.models.layers import mlp
from sceneprior.models.logistics import LogisticMixture, draw_index

END = 0
"""The class that ends a room: void, which is no furniture."""
CLASS_WIDTH = 64
OCTAVES = 8
"""Sines and cosines a coordinate is shown to the network as; the finest has a period of two steps
of the mixture. The published 32 octaves go far below what a float32 can tell apart."""
BATCH = 256
"""Rooms sampled at a time."""


class Atiss(nn.Module):
    """Objects one after the other, each given the set of those before it.

    A transformer encoder without positional encoding reads the objects there are and one learnt
    query. What it makes of the query gives the class of the next object, or the room's end; then,
    given the class, its position; then, given both, its size. Every coordinate is a mixture of
    logistics of its own.

    Args:
        classes: Size of the label set, void included.
        max_objects: Where sampling stops, if the end was not drawn before.
        width, layers, heads, hidden, dropout: Of the encoder.
        mixtures: Logistics a coordinate.
    """

    low_m: Tensor
    high_m: Tensor

    def __init__(
        self,
        classes: int,
        max_objects: int,
        width: int,
        layers: int,
        heads: int,
        hidden: int,
        mixtures: int,
        dropout: float,
    ):
        super().__init__()
        self.max_objects = max_objects
        self.register_buffer("low_m", torch.zeros(6))
        self.register_buffer("high_m", torch.ones(6))
        self.class_embedding = nn.Embedding(classes, CLASS_WIDTH)
        self.object = nn.Linear(CLASS_WIDTH + 6 * 2 * OCTAVES, width)
        self.query = nn.Parameter(torch.randn(width))
        self.encoder = nn.ModuleList(
            nn.TransformerEncoderLayer(
                width, heads, hidden, dropout, activation="gelu", batch_first=True
            )
            # Each drawn by itself; nn.TransformerEncoder would start with copies of one.
            for _ in range(layers)
        )
        of_three = 3 * 3 * mixtures
        self.class_head = _head(width, classes)
        self.position_head = _head(width + CLASS_WIDTH, of_three)
        self.size_head = _head(width + CLASS_WIDTH + 3 * 2 * OCTAVES, of_three)

    def fit_bounds(self, rooms: RoomBoxes) -> None:
        """Take the range of every coordinate and size from the training rooms."""
        boxes_m = rooms.boxes_m[rooms.is_object]
        self.low_m.copy_(boxes_m.amin(dim=0))
        # Where all are alike (a toy), a range of nothing would divide by nothing.
        self.high_m.copy_(torch.maximum(boxes_m.amax(dim=0), self.low_m + 1e-3))

    def to_unit(self, boxes_m: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 6"]:
        """From metres to [-1, 1]."""
        return 2 * (boxes_m - self.low_m) / (self.high_m - self.low_m) - 1

    def to_metres(self, unit: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 6"]:
        """From [-1, 1] to metres."""
        return self.low_m + (unit + 1) / 2 * (self.high_m - self.low_m)

    def context(
        self,
        object_class: Int[Tensor, "rooms objects"],
        unit: Float[Tensor, "rooms objects 6"],
        is_object: Bool[Tensor, "rooms objects"],
    ) -> Float[Tensor, "rooms width"]:
        """What a set of objects, in whatever order, means for the next one."""
        objects = torch.cat([self.class_embedding(object_class), waves(unit)], dim=-1)
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
        next_unit: Float[Tensor, "rooms 6"],
    ) -> dict[str, Float[Tensor, " rooms"]]:
        """Log-probability of the next object's class, position and size; of the latter two 0 where
        the next class is `END`."""
        class_log_prob = self.class_head(context).log_softmax(dim=-1)
        label = self.class_embedding(next_class)
        exists = next_class != END
        position = self._position(context, label).log_prob(next_unit[:, :3]).sum(dim=-1)
        size = self._size(context, label, next_unit[:, :3]).log_prob(next_unit[:, 3:]).sum(dim=-1)
        return {
            "class": class_log_prob.gather(-1, next_class[:, None])[:, 0],
            "position": position * exists,
            "size": size * exists,
        }

    def _position(self, context: Tensor, label: Tensor) -> LogisticMixture:
        features = self.position_head(torch.cat([context, label], dim=-1))
        return LogisticMixture.of(features.unflatten(-1, (3, -1)))

    def _size(self, context: Tensor, label: Tensor, position: Tensor) -> LogisticMixture:
        features = self.size_head(torch.cat([context, label, waves(position)], dim=-1))
        return LogisticMixture.of(features.unflatten(-1, (3, -1)))

    @torch.no_grad()
    def sample(self, count: int, seed: int) -> RoomBoxes:
        """New rooms. The same seed gives the same rooms, the first of them however many follow."""
        generator = torch.Generator().manual_seed(seed)
        uniform = torch.rand(count, self.max_objects, 13, generator=generator)
        parts = [self._sample(part) for part in uniform.to(self.query.device).split(BATCH)]
        return RoomBoxes(
            object_class=torch.cat([part.object_class for part in parts]),
            is_object=torch.cat([part.is_object for part in parts]),
            boxes_m=torch.cat([part.boxes_m for part in parts]),
        )

    def _sample(self, uniform: Float[Tensor, "rooms objects 13"]) -> RoomBoxes:
        rooms = len(uniform)
        object_class = torch.zeros(rooms, self.max_objects, dtype=torch.long, device=uniform.device)
        unit = uniform.new_zeros(rooms, self.max_objects, 6)
        is_object = torch.zeros_like(object_class, dtype=torch.bool)
        going = torch.ones_like(is_object[:, 0])
        for step in range(self.max_objects):
            context = self.context(object_class[:, :step], unit[:, :step], is_object[:, :step])
            drawn, choice, place = uniform[:, step].split([1, 6, 6], dim=-1)
            next_class = draw_index(self.class_head(context), drawn[:, 0])
            going = going & (next_class != END)
            label = self.class_embedding(next_class)
            position = self._position(context, label).draw(choice[:, :3], place[:, :3])
            size = self._size(context, label, position).draw(choice[:, 3:], place[:, 3:])
            object_class[:, step] = next_class * going
            unit[:, step] = torch.cat([position, size], dim=-1)
            is_object[:, step] = going
        return RoomBoxes(object_class, is_object, self.to_metres(unit))


def waves(unit: Float[Tensor, "*batch numbers"]) -> Float[Tensor, "*batch waves"]:
    """Each number of [-1, 1] as sines and cosines of `OCTAVES` octaves."""
    octaves = math.pi * 2.0 ** torch.arange(OCTAVES, device=unit.device, dtype=unit.dtype)
    phase = (unit.unsqueeze(-1) * octaves).flatten(-2)
    return torch.cat([phase.sin(), phase.cos()], dim=-1)


def _head(inputs: int, outputs: int) -> nn.Sequential:
    return mlp(nn.Linear(inputs, inputs), nn.Linear(inputs, outputs))

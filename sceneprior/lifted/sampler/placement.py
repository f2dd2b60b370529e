"""The distribution of an object's place: a mixture over places relative to room and objects."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sceneprior.core.mixtures import LogisticMixture
from sceneprior.paper.layers import mlp

EDGES = 2
"""Logistics per place that is determined by the room."""
KNOWN = 4
"""Reference positions along an axis: flush with either side of the rectangle, its middle, and the
origin, which is the floor's middle. Places determined by the room are their pairs."""
BESIDE = 6
"""Logistics per object that is already placed."""


class Placement(nn.Module):
    """The distribution of a footprint's centre (x, z).

    A mixture of logistics of two kinds. The means of the first are determined by the room: along x
    and along z flush with a side of the rectangle, in its middle, or in the middle of the floor,
    plus a predicted shift. The means of the second are, for each object already placed,

        its centre + a * half the sum of both sizes + b * half their difference + c,

    so that a = 1 means "adjacent to it" and b = 1 "flush with its side", whatever the sizes. The
    network predicts a and b in [-1.5, 1.5], c in metres, and all weights and scales.
    """

    def __init__(self, width: int):
        super().__init__()
        self.from_query = nn.Linear(width, width)
        self.from_object = nn.Linear(width, width)
        # outputs: log-weight, then shift and log-scale of x and z
        self.of_rectangle = mlp(nn.Linear(width, width), nn.Linear(width, KNOWN**2 * EDGES * 5))
        # outputs: log-weight, then a, b, c and log-scale of x and z
        self.of_object = mlp(nn.Linear(width, width), nn.Linear(width, BESIDE * 9))

    def forward(
        self,
        query: Float[Tensor, "rooms width"],
        size_m: Float[Tensor, "rooms 2"],
        rectangle_m: Float[Tensor, "rooms 4"],
        objects: Float[Tensor, "rooms objects width"],
        boxes_m: Float[Tensor, "rooms objects 4"],
        is_object: Bool[Tensor, "rooms objects"],
    ) -> LogisticMixture:
        """The mixture for a footprint of `size_m` in a rectangle (centre x, z, extents x, z), given
        the features `objects` of the objects already placed and their footprints `boxes_m`, in the
        same format as `rectangle_m`."""
        own = self.from_query(query)
        free = ((rectangle_m[:, 2:] - size_m) / 2).clamp(min=0)
        middle = rectangle_m[:, :2]
        known = torch.stack([middle - free, middle, middle + free, torch.zeros_like(free)], dim=1)
        x, z = known.unbind(dim=-1)
        pairs = [x.repeat_interleave(KNOWN, dim=1), z.repeat(1, KNOWN)]
        edges = self.of_rectangle(torch.relu(own)).unflatten(-1, (KNOWN**2, EDGES, 5))
        means = torch.stack(pairs, dim=-1).unsqueeze(2) + edges[..., 1:3]
        at_edges = (edges[..., 0], means, edges[..., 3:])

        pair = torch.relu(own.unsqueeze(1) + self.from_object(objects))
        weight, a, b, c, scale = (
            self.of_object(pair).unflatten(-1, (BESIDE, 9)).split([1, 2, 2, 2, 2], dim=-1)
        )
        total = (boxes_m[..., 2:] + size_m.unsqueeze(1)).unsqueeze(-2) / 2
        difference = (boxes_m[..., 2:] - size_m.unsqueeze(1)).unsqueeze(-2) / 2
        means = boxes_m[..., None, :2] + 1.5 * a.tanh() * total + 1.5 * b.tanh() * difference + c
        weights = weight[..., 0].masked_fill(~is_object.unsqueeze(-1), -torch.inf)
        beside = (weights, means, scale)
        joined = [
            torch.cat([one.flatten(1, 2), other.flatten(1, 2)], dim=1)
            for one, other in zip(at_edges, beside, strict=True)
        ]
        return LogisticMixture.bounded(*joined)

"""Where an object stands: a mixture over what it may stand in relation to."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sceneprior.models.layers import mlp
from sceneprior.sampler.mixtures import LogisticMixture

EDGES = 2
"""Logistics of each place that a room knows."""
KNOWN = 4
"""Places along an axis: at either side of the rectangle, in its middle, and where the floor's
middle is, the origin. A room knows their pairs."""
BESIDE = 6
"""Logistics of each object that something may stand in relation to."""


class Placement(nn.Module):
    """The distribution of a footprint's centre (x, z).

    A mixture of logistics. Some have their means at a place that the room knows: along x and along
    z flush with a side of the rectangle, in its middle, or in the middle of the floor. The others,
    of each object that stands already, at

        its centre + a * half the sum of both sizes + b * half their difference + c,

    so that one number says "flush with it" or "in line with it", whatever the sizes. The network
    gives a and b in [-1.5, 1.5], c in metres, and all weights and scales.
    """

    def __init__(self, width: int):
        super().__init__()
        self.from_query = nn.Linear(width, width)
        self.from_object = nn.Linear(width, width)
        # log-weight, then shift and log-scale of x and z
        self.of_rectangle = mlp(nn.Linear(width, width), nn.Linear(width, KNOWN**2 * EDGES * 5))
        # log-weight, then a, b, c and log-scale of x and z
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
        """The mixture for a footprint of `size_m` in a rectangle (centre x, z, extents x, z), with
        objects of features `objects` and footprints `boxes_m`, which are like `rectangle_m`."""
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

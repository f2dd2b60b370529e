"""Parts that the authors' released code adds to the paper's network, each by a key of a config.

Written from descriptions of that code, not from the code. Off by default.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.models.layers import mlp


class StepOutputs(nn.Module):
    """Step k ends in a two-layer MLP of its own, whose weights tell the object that it is the kth.

    What it gives is x_k, which later steps see, too. `steps` is N, `width` a feature's size.
    """

    def __init__(self, steps: int, width: int):
        super().__init__()
        self.mlps = nn.ModuleList(
            mlp(nn.Linear(width, width), nn.Linear(width, width)) for _ in range(steps)
        )

    def forward(self, x: Float[Tensor, "rooms width"], step: int) -> Float[Tensor, "rooms width"]:
        return self.mlps[step](x)


class QuerySelfAttention(nn.Module):
    """The decoder layer's self attention, over the one query z: a residual layer and its norm.

    A softmax over one score is 1 whatever the query and the key, so neither is there.
    """

    def __init__(self, width: int, heads: int, dropout: float):
        super().__init__()
        self.heads = heads
        self.value = nn.Linear(width, width)
        self.out = nn.Linear(width, width)
        self.norm = nn.LayerNorm(width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, z: Float[Tensor, "rooms width"]) -> Float[Tensor, "rooms width"]:
        share = self.dropout(z.new_ones(len(z), self.heads, 1))  # one attention weight a head
        value = (share * self.value(z).unflatten(-1, (self.heads, -1))).flatten(1)
        return self.norm(z + self.dropout(self.out(value)))


class SeparateHeads(nn.Module):
    """In place of MLP2: one linear layer for the classes, an MLP of its own for each coordinate.

    `hidden` is the size of MLP1's output and of each coordinate's hidden layer.
    """

    def __init__(self, hidden: int, classes: int):
        super().__init__()
        self.classes = nn.Linear(hidden, classes)
        self.coordinates = nn.ModuleList(
            mlp(nn.Linear(hidden, hidden), nn.Linear(hidden, 1))
            for _ in ("x", "y", "z", "width", "height", "depth")
        )
        self.completeness = nn.Linear(hidden, 1)

    def forward(
        self, shared: Float[Tensor, "rooms objects hidden"]
    ) -> Float[Tensor, "rooms objects outputs"]:
        """Class logits, x, y, z, width, height, depth and completeness: MLP2's order."""
        x = F.relu(shared)
        parts = [self.classes(x), *(head(x) for head in self.coordinates), self.completeness(x)]
        return torch.cat(parts, dim=-1)

    def rows(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and bias of each output in its last layer, in the outputs' order."""
        coordinates = (head[-1] for head in self.coordinates)  # type: ignore[index]
        last = (self.classes, *coordinates, self.completeness)
        return [row for layer in last for row in zip(layer.weight, layer.bias, strict=True)]

"""Parts that the authors' released code adds to the paper's network, each enabled by a config key.

They are written from descriptions of that code, not from the code itself, and are off by default.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.paper.layers import mlp


class StepOutputs(nn.Module):
    """A separate two-layer MLP at the end of each step k, so that features depend on k.

    The output of the MLP is x_k, which later steps read, too. `steps` is N, and `width` the size of
    a feature.
    """

    def __init__(self, steps: int, width: int):
        super().__init__()
        self.mlps = nn.ModuleList(
            mlp(nn.Linear(width, width), nn.Linear(width, width)) for _ in range(steps)
        )

    def forward(self, x: Float[Tensor, "rooms width"], step: int) -> Float[Tensor, "rooms width"]:
        return self.mlps[step](x)


class QuerySelfAttention(nn.Module):
    """The decoder layer's self-attention over its single query z: a residual layer and its norm.

    The softmax over a single score is always 1, so the layer has no query and key projections.
    """

    def __init__(self, width: int, heads: int, dropout: float):
        super().__init__()
        self.heads = heads
        self.value = nn.Linear(width, width)
        self.out = nn.Linear(width, width)
        self.norm = nn.LayerNorm(width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, z: Float[Tensor, "rooms width"]) -> Float[Tensor, "rooms width"]:
        share = self.dropout(z.new_ones(len(z), self.heads, 1))  # one attention weight per head
        value = (share * self.value(z).unflatten(-1, (self.heads, -1))).flatten(1)
        return self.norm(z + self.dropout(self.out(value)))


class SeparateHeads(nn.Module):
    """Replacement of MLP2: a linear layer for the classes and a separate MLP for each coordinate.

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
        """Class logits, x, y, z, width, height, depth and completeness, in the order of
        `JointHead`."""
        x = F.relu(shared)
        parts = [self.classes(x), *(head(x) for head in self.coordinates), self.completeness(x)]
        return torch.cat(parts, dim=-1)

    def rows(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and bias of each output of the last layers, in the order of the outputs."""
        coordinates = (head[-1] for head in self.coordinates)  # type: ignore[index]
        last = (self.classes, *coordinates, self.completeness)
        return [row for layer in last for row in zip(layer.weight, layer.bias, strict=True)]

"""The encoder of ATISS in the transformer's place: the baseline ATISS-2D."""

from typing import Literal

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from sceneprior.models.layers import DecoderConfig


class Atiss2dConfig(DecoderConfig):
    """Size of the encoder; published: 4 layers, 8 heads and an FFN of 1,024 at width 512."""

    name: Literal["atiss2d"] = "atiss2d"
    layers: int = Field(4, ge=1, le=100)
    heads: int = Field(8, ge=1)
    """Attention heads; must divide D_z."""
    hidden: int = Field(1024, ge=8)
    """Inner width of the feed-forward layers."""
    dropout: float = Field(0.1, ge=0, lt=1)
    norm_first: bool = False
    """Normalise before attention and feed-forward, not after their residuals as published. Learns
    at higher rates (docs/baselines_2d.md)."""

    def build(self, width: int, max_objects: int) -> "SceneAtiss":
        return SceneAtiss(width, self)


class SceneAtiss(nn.Module):
    """x_k is what the encoder makes of z among x_1 .. x_(k-1).

    ATISS appends a learnt 'empty' embedding to the set of objects that are there, and reads the
    next object off the place where it stood. Here z is that embedding (supplement, Baselines), so
    there is nothing to learn for the empty room, and no floor plan, which 2D views do not show.
    Nothing tells the tokens' order. Each layer normalises after its residuals, unless told
    otherwise, and the last is normalised once more, as in the library that ATISS builds on.

    Every token sees every other, so that a new object changes what all layers say of the old ones:
    each step encodes its set anew.
    """

    def __init__(self, width: int, config: Atiss2dConfig):
        super().__init__()
        # Layers one by one: TransformerEncoder copies its layer, so that all would start alike.
        self.layers = nn.ModuleList(
            nn.TransformerEncoderLayer(
                width,
                config.heads,
                config.hidden,
                config.dropout,
                "gelu",
                batch_first=True,
                norm_first=config.norm_first,
            )
            for _ in range(config.layers)
        )
        self.end = nn.LayerNorm(width)

    def forward(
        self,
        z: Float[Tensor, "rooms width"],
        objects: int,
        needed: Int[Tensor, " rooms"] | None = None,
    ) -> Float[Tensor, "rooms objects width"]:
        """Unroll `objects` steps from the empty set."""
        features = z.new_zeros(len(z), 0, z.shape[-1])
        for _ in range(objects):
            newest = self.next_object(z, features)
            features = torch.cat([features.to(newest.dtype), newest.unsqueeze(1)], dim=1)
        return features

    def next_object(
        self,
        z: Float[Tensor, "rooms width"],
        previous: Float[Tensor, "rooms objects width"],
    ) -> Float[Tensor, "rooms width"]:
        """The feature that follows a set of objects, in whatever order they are given.

        z is scaled as it is for the transformer: to about the size of the features beside it.
        """
        tokens = torch.cat([(z * z.shape[-1] ** 0.5).unsqueeze(1), previous.to(z.dtype)], dim=1)
        for layer in self.layers:
            tokens = layer(tokens)
        return self.end(tokens[:, 0])

"""Baseline decoders of object features, in place of the paper's transformer: the LSTM of ablation
c2 and Table 1, and ATISS-2D, the encoder of ATISS."""

from typing import Literal

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from sceneprior.core.settings import Section
from sceneprior.paper.transformer import DecoderConfig


class LstmConfig(DecoderConfig):
    """The LSTM has no settings: its state is as wide as its features."""

    name: Literal["lstm"] = "lstm"

    def build(self, width: int, max_objects: int) -> "SceneLstm":
        return SceneLstm(width)


class SceneLstm(nn.Module):
    """x_k is the LSTM's output on x_(k-1), and x_0 is z.

    It has one layer, whose state starts at zero. Unlike the transformer's, its output depends on
    the order of the previous objects, and only the first step reads z. `width` is D_z.
    """

    def __init__(self, width: int):
        super().__init__()
        self.cell = nn.LSTMCell(width, width)

    def forward(
        self,
        z: Float[Tensor, "rooms width"],
        objects: int,
        needed: Int[Tensor, " rooms"] | None = None,
    ) -> Float[Tensor, "rooms objects width"]:
        """Features of `objects` objects; z is scaled as in the paper's transformer."""
        feature, state = z * z.shape[-1] ** 0.5, None
        features: list[Tensor] = []
        for _ in range(objects):
            state = self.cell(feature, state)
            feature = state[0]
            features.append(feature)
        return torch.stack(features, dim=1)


class EncoderConfig(Section):
    """Size of the encoder of ATISS and of ATISS-2D; the defaults are the published settings."""

    layers: int = Field(4, ge=1, le=100)
    """Layers of the transformer encoder; more need more rooms."""
    heads: int = Field(8, ge=1)
    """Attention heads; must divide the width."""
    hidden: int = Field(1024, ge=8)
    """Inner width of the feed-forward layers."""
    dropout: float = Field(0.1, ge=0, lt=1)
    """Share of activations dropped in training; more delays overfitting."""

    def build_layers(self, width: int, norm_first: bool = False) -> nn.ModuleList:
        """Freshly initialised layers, each with its own weights. `nn.TransformerEncoder` would
        start with copies of one layer."""
        return nn.ModuleList(
            nn.TransformerEncoderLayer(
                width, self.heads, self.hidden, self.dropout, "gelu",
                batch_first=True, norm_first=norm_first,
            )
            for _ in range(self.layers)
        )  # fmt: skip


class Atiss2dConfig(EncoderConfig, DecoderConfig):
    """Size of the encoder; the published width is 512."""

    name: Literal["atiss2d"] = "atiss2d"
    norm_first: bool = False
    """If true, normalise before attention and feed-forward layers; if false, after their residuals
    (as published). Normalising before allows higher learning rates (docs/baselines_2d.md)."""

    def build(self, width: int, max_objects: int) -> "SceneAtiss":
        return SceneAtiss(width, self)


class SceneAtiss(nn.Module):
    """x_k is the encoder's output at z, given the tokens z, x_1, .., x_(k-1).

    ATISS adds a learnt 'empty' embedding to the set of objects and reads the next object at its
    position. Here z is that embedding (supplement, Baselines). The floor plan of ATISS is left out,
    because 2D views do not show it. Tokens have no positional encoding. The output is normalised
    once more, as in the library that ATISS builds on.

    Every token attends to every other, so each step encodes the whole set again.
    """

    def __init__(self, width: int, config: Atiss2dConfig):
        super().__init__()
        self.layers = config.build_layers(width, config.norm_first)
        self.end = nn.LayerNorm(width)

    def forward(
        self,
        z: Float[Tensor, "rooms width"],
        objects: int,
        needed: Int[Tensor, " rooms"] | None = None,
    ) -> Float[Tensor, "rooms objects width"]:
        """Features of `objects` objects, generated from the empty set."""
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
        """The feature of the next object; it does not depend on the order of the previous ones.

        z is scaled to about the size of the features, as in the paper's transformer.
        """
        tokens = torch.cat([(z * z.shape[-1] ** 0.5).unsqueeze(1), previous.to(z.dtype)], dim=1)
        for layer in self.layers:
            tokens = layer(tokens)
        return self.end(tokens[:, 0])

"""The LSTM of ablation c2 and Table 1, in place of the paper's transformer."""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from sceneprior.paper.layers import DecoderConfig


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

"""The LSTM of ablation c2 and Table 1, which takes the transformer's place."""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from sceneprior.models.layers import DecoderConfig


class LstmConfig(DecoderConfig):
    """An LSTM as wide as its features has nothing to choose."""

    name: Literal["lstm"] = "lstm"

    def build(self, width: int, max_objects: int) -> "SceneLstm":
        return SceneLstm(width)


class SceneLstm(nn.Module):
    """x_k is the LSTM's output on x_(k-1), and x_0 is z.

    One layer whose state begins at zero. Unlike the transformer's, its output depends on the order
    of the objects before, and z is an input of the first step alone. `width` is D_z, and the
    state's size.
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
        """Unroll `objects` steps; z is scaled as it is for the transformer."""
        feature, state = z * z.shape[-1] ** 0.5, None
        features: list[Tensor] = []
        for _ in range(objects):
            state = self.cell(feature, state)
            feature = state[0]
            features.append(feature)
        return torch.stack(features, dim=1)

"""The transformer encoder of ATISS, which the baselines ATISS and ATISS-2D share."""

from pydantic import Field
from torch import nn

from sceneprior.core.settings import Section


class EncoderConfig(Section):
    """Size of the encoder; the defaults are the published settings."""

    layers: int = Field(4, ge=1, le=100)
    heads: int = Field(8, ge=1)
    """Attention heads; must divide the width."""
    hidden: int = Field(1024, ge=8)
    """Inner width of the feed-forward layers."""
    dropout: float = Field(0.1, ge=0, lt=1)

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

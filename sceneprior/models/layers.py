"""What several modules share: perceptrons, dropout, and the base of decoders' sections."""

import math
from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.settings import Section


def mlp(*layers: nn.Module, slope: float = 0.0) -> nn.Sequential:
    """Layers one after the other, with a ReLU between each two: a leaky one, if it has a `slope`.

    Example:

        >>> mlp(nn.Linear(3, 8), nn.Linear(8, 2))
        Sequential(
          (0): Linear(in_features=3, out_features=8, bias=True)
          (1): ReLU()
          (2): Linear(in_features=8, out_features=2, bias=True)
        )
    """
    between = nn.LeakyReLU(slope) if slope else nn.ReLU()
    return nn.Sequential(*[part for layer in layers for part in (layer, between)][:-1])


def dropout(x: Float[Tensor, "*shape"], p: float) -> Float[Tensor, "*shape"]:
    """Each number with probability `p` set to 0, else divided by 1 - p, as `F.dropout` in training.

    A CPU draws where zeros go instead of asking every number, in a quarter of the time: of n
    numbers as many positions as Poisson(-n ln(1 - p)) says, each anywhere. A number is hit
    Poisson(-ln(1 - p)) times, independently of all others, so never with probability 1 - p.
    """
    if p == 0 or x.device.type != "cpu":
        return F.dropout(x, p)
    hits = torch.poisson(torch.tensor(-x.numel() * math.log1p(-p), dtype=torch.float64))
    scale = x.new_full((x.numel(),), 1 / (1 - p))
    scale.scatter_(0, torch.randint(max(x.numel(), 1), (int(hits),)), 0)
    return x * scale.view(x.shape)


class DecoderConfig(Section, ABC):
    """What makes object features x_k of a latent z: a section that builds its module.

    The module takes (z of shape (rooms, D_z), N) to features of shape (rooms, N, D_z); it may be
    told how many of the N each room needs, and what it says of the others then means nothing.
    """

    name: str

    @abstractmethod
    def build(self, width: int, max_objects: int) -> nn.Module:
        """The module, for features of D_z = `width`, freshly initialised."""

"""What several modules share: multi-layer perceptrons, and the base of decoders' sections."""

from abc import ABC, abstractmethod

from torch import nn

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


class DecoderConfig(Section, ABC):
    """What makes object features x_k of a latent z: a section that builds its module.

    The module takes (z of shape (rooms, D_z), N) to features of shape (rooms, N, D_z); it may be
    told how many of the N each room needs, and what it says of the others then means nothing.
    """

    name: str

    @abstractmethod
    def build(self, width: int, max_objects: int) -> nn.Module:
        """The module, for features of D_z = `width`, freshly initialised."""

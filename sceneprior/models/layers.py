"""Multi-layer perceptrons of given layers."""

from torch import nn


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

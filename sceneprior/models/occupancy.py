"""The occupancy decoder: from an object's feature to a grid of logits in its box's frame.

Ours, in place of the paper's deformed template: a grid may have legs, holes and thin tops.
"""

from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from sceneprior.settings import Section

FINEST = 3.0
"""Weight of the finest grid: smoothing takes much of what Adam changes there."""
START = 0.02
"""Spread of the linear layer's weights before training. Logits begin as small, smooth noise about
0: nothing is decided, and rays pull on every cell that they pass."""


class OccupancyConfig(Section):
    """Shapes as occupancy grids."""

    name: Literal["occupancy"] = "occupancy"
    width: int = Field(64, ge=8)
    """Hidden width: how many grids all shapes are weighted sums of."""
    cells: int = Field(32, ge=8, le=64, multiple_of=4)
    """Cells along each axis of the grid."""
    margin: float = Field(1.1, ge=1, le=2)
    """The grid fills the object's box times this. A box that is a little too small can then still
    learn from rays that pass beside it."""

    def build(self, features: int) -> "OccupancyDecoder":
        """The module for object features of such a width, freshly initialised."""
        return OccupancyDecoder(features, self)


class OccupancyDecoder(nn.Module):
    """A weighted sum of learnt grids; an MLP on MLP1's output (`features` wide) gives the weights.

        logits = [MLP(x), 1] @ basis
        basis  = up(coarse) + up(middle) + FINEST * smooth(fine)

    Each learnt grid is the sum of three, of a quarter, a half and all of the cells along an axis:
    the coarse one moves what is large at once, the fine one adds detail. `up` is trilinear between
    the cells' centres, `smooth` a mean over three cells along each axis. Both are linear, so they
    are applied to the `width` + 1 learnt grids once a step, and not to every object's.
    """

    nothing: ClassVar[float] = -20.0
    """The logits of an object that was not decoded: empty."""

    def __init__(self, features: int, config: OccupancyConfig):
        super().__init__()
        width, cells = config.width, config.cells
        self.cells, self.margin = cells, config.margin
        self.code = nn.Sequential(
            nn.ReLU(), nn.Linear(features, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
        )
        rows = width + 1  # the last is of the constant: what all shapes share

        def grids(size: int) -> nn.Parameter:
            return nn.Parameter(START * torch.randn(rows, size, size, size))

        self.coarse, self.middle, self.fine = grids(cells // 4), grids(cells // 2), grids(cells)
        self.from_coarse: Tensor
        self.from_middle: Tensor
        self.smoothing: Tensor
        self.register_buffer("from_coarse", up_sampling(cells // 4, cells), persistent=False)
        self.register_buffer("from_middle", up_sampling(cells // 2, cells), persistent=False)
        self.register_buffer("smoothing", box_filter(cells), persistent=False)

    def forward(
        self, features: Float[Tensor, "rooms objects features"]
    ) -> Float[Tensor, "rooms objects cells cells cells"]:
        """Occupancy logits, indexed x, y, z: positive inside the object, of the centres of cells
        that fill the box times `margin`."""
        code = self.code(features)
        *learnt, shared = self.basis().flatten(1).split([code.shape[-1], 1])
        grids = torch.addmm(shared.to(code), code.flatten(0, 1), learnt[0].to(code))
        return grids.unflatten(1, (self.cells,) * 3).unflatten(0, features.shape[:2])

    def basis(self) -> Float[Tensor, "rows cells cells cells"]:
        """The learnt grids at full resolution; the last is of the constant."""
        coarse = along_each_axis(self.coarse, self.from_coarse)
        middle = along_each_axis(self.middle, self.from_middle)
        return coarse + middle + along_each_axis(self.fine, FINEST ** (1 / 3) * self.smoothing)


def along_each_axis(
    grids: Float[Tensor, "rows n n n"], matrix: Float[Tensor, "m n"]
) -> Float[Tensor, "rows m m m"]:
    """Apply a linear map from n to m cells along x, y and z."""
    rows, n = grids.shape[0], matrix.shape[1]
    m = matrix.shape[0]
    along_z = grids @ matrix.T
    along_y = matrix @ along_z
    return (matrix @ along_y.view(rows, n, m * m)).view(rows, m, m, m)


def up_sampling(n: int, m: int) -> Float[Tensor, "m n"]:
    """Linear interpolation from the centres of n cells to those of m that fill the same length;
    beyond the outermost centres, their values.

    Example:

        >>> up_sampling(2, 4)
        tensor([[1.0000, 0.0000],
                [0.7500, 0.2500],
                [0.2500, 0.7500],
                [0.0000, 1.0000]])
    """
    place = ((torch.arange(m) + 0.5) * n / m - 0.5).clamp(0, n - 1)
    # Weight of a cell: 1 at its own centre, 0 from the next centre on.
    return (1 - (place[:, None] - torch.arange(n)).abs()).clamp(min=0)


def box_filter(n: int) -> Float[Tensor, "n n"]:
    """The mean of each cell and its two neighbours; the outermost cells stand in for those beyond.

    Example:

        >>> box_filter(3) * 3
        tensor([[2., 1., 0.],
                [1., 1., 1.],
                [0., 1., 2.]])
    """
    cells = torch.arange(n)
    neighbours = (cells[:, None] + torch.tensor([-1, 0, 1])).clamp(0, n - 1)
    return torch.nn.functional.one_hot(neighbours, n).float().mean(dim=1)

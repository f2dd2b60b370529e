"""The occupancy decoder: from an object's feature to a grid of logits in its box's frame.

Ours, in place of the paper's deformed template: a grid may have legs, holes and thin tops.
"""

from typing import ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from sceneprior.settings import Section

LOGITS = 8.0
"""Logits an occupancy: full cells have a logit of 4, empty ones of -4."""


class OccupancyConfig(Section):
    """Shapes as occupancy grids."""

    name: Literal["occupancy"] = "occupancy"
    codes: int = Field(128, ge=1)
    """How many grids all shapes are weighted sums of: principal components of the shapes lifted
    from the training rooms' masks (`lifting/shapes.py`)."""
    width: int = Field(128, ge=8)
    """Hidden width of the MLP that gives the weights."""
    cells: int = Field(32, ge=8, le=64)
    """Cells along each axis of the grid."""
    margin: float = Field(1.1, ge=1, le=2)
    """The grid fills the object's box times this."""

    def build(self, features: int) -> "OccupancyDecoder":
        """The module for object features of such a width, freshly initialised."""
        return OccupancyDecoder(features, self)


class OccupancyDecoder(nn.Module):
    """A mean grid plus a weighted sum of given ones; an MLP on MLP1's output gives the weights.

        occupancy = mean + spread * MLP(x) @ basis

    Mean and basis are no parameters: training finds them from the data before its first step
    (`set_space`), checkpoints keep them, and a resumed run's targets are weights of the same. Since
    the basis is orthonormal, the squared distance of two grids, summed over cells, is that of their
    weights: training needs no grid.
    """

    nothing: ClassVar[float] = -20.0
    """The logits of an object that was not decoded: empty."""

    def __init__(self, features: int, config: OccupancyConfig):
        super().__init__()
        width, cells, codes = config.width, config.cells, config.codes
        self.cells, self.margin = cells, config.margin
        self.mlp = nn.Sequential(
            nn.ReLU(),
            nn.Linear(features, width), nn.SiLU(),
            nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, codes),
        )  # fmt: skip
        # Half the size of checkpoints; an occupancy of 0.5 is known to 0.0005.
        self.mean: Tensor
        self.basis: Tensor
        self.spread: Tensor
        self.register_buffer("mean", torch.zeros(cells, cells, cells, dtype=torch.float16))
        self.register_buffer("basis", torch.zeros(codes, cells, cells, cells, dtype=torch.float16))
        self.register_buffer("spread", torch.ones(()))

    def set_space(
        self,
        mean: Float[np.ndarray, "cells cells cells"],
        basis: Float[np.ndarray, "codes cells cells cells"],
        spread: float,
    ) -> None:
        """Decode in this shape space from now on; see `lifting.shapes.ShapeSpace`."""
        self.mean.copy_(torch.from_numpy(mean))
        self.basis.copy_(torch.from_numpy(basis))
        self.spread.fill_(spread)

    @property
    def space(
        self,
    ) -> tuple[
        Float[np.ndarray, "cells cells cells"], Float[np.ndarray, "codes cells cells cells"], float
    ]:
        """What `set_space` was given, as far as half precision holds it."""
        mean, basis = (part.float().cpu().numpy() for part in (self.mean, self.basis))
        return mean, basis, self.spread.item()

    def codes(
        self, features: Float[Tensor, "*objects features"]
    ) -> Float[Tensor, "*objects codes"]:
        """The weights of objects' shapes."""
        weights: Tensor = self.mlp(features) * self.spread
        return weights

    def forward(
        self, features: Float[Tensor, "rooms objects features"]
    ) -> Float[Tensor, "rooms objects cells cells cells"]:
        """The grids of objects' features; see `grids`."""
        return self.grids(self.codes(features))

    def grids(
        self, codes: Float[Tensor, "rooms objects codes"]
    ) -> Float[Tensor, "rooms objects cells cells cells"]:
        """Occupancy logits, indexed x, y, z: positive inside the object, of the centres of cells
        that fill the box times `margin`."""
        grids = torch.addmm(
            self.mean.to(codes).flatten(), codes.flatten(0, 1), self.basis.to(codes).flatten(1)
        )
        logits = LOGITS * (grids - 0.5)
        return logits.unflatten(1, (self.cells,) * 3).unflatten(0, codes.shape[:2])

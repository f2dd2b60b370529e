"""The occupancy decoder: from an object's feature to one of a few shapes, in one of its poses.

Ours, in place of the paper's deformed template: such a shape may have legs, holes and thin tops.
"""

from typing import ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from sceneprior.geometry.isosurface import surface_of
from sceneprior.geometry.turns import quarter_rotation
from sceneprior.models.prototypes import POSES, Prototypes, looks_apart, turn_of
from sceneprior.scene import Mesh
from sceneprior.settings import Section


class OccupancyConfig(Section):
    """Shapes as occupancy grids, some of them lifted from the training rooms' masks."""

    name: Literal["occupancy"] = "occupancy"
    prototypes: int = Field(1024, ge=1)
    """Shapes that stand for those of all objects, at most."""
    codes: int = Field(128, ge=1)
    """Numbers that say which shape it is: looks that are alike have codes that are near."""
    width: int = Field(128, ge=8)
    """Hidden width of the MLP that gives the code."""
    cells: int = Field(32, ge=8, le=64)
    """Cells along each axis of the grid."""
    margin: float = Field(1.1, ge=1, le=2)
    """The grid fills the object's box times this."""

    def build(self, features: int) -> "OccupancyDecoder":
        """The module for object features of such a width, freshly initialised."""
        return OccupancyDecoder(features, self)


class OccupancyDecoder(nn.Module):
    """An MLP on MLP1's output gives a code; the object has the look whose code is nearest.

    A look is a prototype, mirrored or not, turned by some quarters. Squared distances between
    looks' codes are those between their grids, as far as so many numbers can say. So the code
    learns by a squared error, near misses cost little, and what is decoded is still a shape with
    sharp outlines and no mean of several. Prototypes and their looks' codes are no parameters:
    training finds them from the data before its first step (`learn_prototypes`), and checkpoints
    keep them.
    """

    unknown: ClassVar[int] = -1
    """Of the class of a prototype that is none: there are fewer than there may be."""

    def __init__(self, features: int, config: OccupancyConfig):
        super().__init__()
        width, cells, most = config.width, config.cells, config.prototypes
        self.cells, self.margin = cells, config.margin
        self.mlp = nn.Sequential(
            nn.ReLU(),
            nn.Linear(features, width), nn.SiLU(),
            nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, config.codes),
        )  # fmt: skip
        self.grid_bits: Tensor
        self.filled: Tensor
        self.sizes_m: Tensor
        self.object_class: Tensor
        self.common: Tensor
        self.look_codes: Tensor
        self.spread: Tensor
        self.register_buffer("grid_bits", torch.zeros(most, -(-(cells**3) // 8), dtype=torch.uint8))
        self.register_buffer("filled", torch.ones(most))
        self.register_buffer("sizes_m", torch.ones(most, 3))
        self.register_buffer("object_class", torch.full((most,), self.unknown))
        self.register_buffer("common", torch.zeros(most, dtype=torch.bool))
        self.register_buffer("look_codes", torch.zeros(most * POSES, config.codes))
        self.register_buffer("spread", torch.ones(()))
        self._meshes: dict[int, Mesh] = {}

    def learn_prototypes(self, prototypes: Prototypes) -> None:
        """Decode into looks of these from now on."""
        count = len(prototypes.grids)
        flat = prototypes.grids.reshape(count, -1)
        self.grid_bits[:count] = torch.from_numpy(np.packbits(flat, axis=1))
        self.filled[:count] = torch.from_numpy(flat.sum(axis=1).clip(min=1).astype(np.float32))
        self.sizes_m[:count] = torch.from_numpy(prototypes.sizes_m)
        self.object_class[:count] = torch.from_numpy(prototypes.object_class)
        self.common[:count] = torch.from_numpy(prototypes.common)
        codes = looks_apart(prototypes.grids, self.look_codes.shape[1])
        self.look_codes[: count * POSES] = torch.from_numpy(codes)
        self.spread.fill_(float(np.sqrt((codes**2).mean())) or 1.0)

    @property
    def prototypes(self) -> Prototypes:
        """What `learn_prototypes` was given."""
        known = self.object_class != self.unknown
        bits, sizes_m, labels, common = (
            part[known].cpu().numpy()
            for part in (self.grid_bits, self.sizes_m, self.object_class, self.common)
        )
        flat = np.unpackbits(bits, axis=1, count=self.cells**3).view(bool)
        grids = flat.reshape(-1, *(self.cells,) * 3)
        return Prototypes(grids, sizes_m.astype(np.float64), labels, common)

    def forward(
        self, features: Float[Tensor, "*objects features"]
    ) -> Float[Tensor, "*objects codes"]:
        """Codes of objects' shapes."""
        codes: Tensor = self.mlp(features) * self.spread
        return codes

    def looks(self, codes: Float[Tensor, "*objects codes"]) -> Int[Tensor, "*objects"]:
        """The look whose code is nearest, the first of equal ones; 0 before there are any."""
        known = (self.object_class != self.unknown).repeat_interleave(POSES).nonzero()[:, 0]
        if not len(known):
            return torch.zeros(codes.shape[:-1], dtype=torch.int64, device=codes.device)
        # Of the most that there may be, few are: comparing with them all takes as long as decoding.
        apart = torch.cdist(codes.flatten(0, -2), self.look_codes[known].to(codes))
        return known[apart.argmin(dim=-1)].unflatten(0, codes.shape[:-1])

    def targets(
        self, looks: Int[Tensor, "*objects"]
    ) -> tuple[Float[Tensor, "*objects codes"], Float[Tensor, "*objects"]]:
        """Codes of looks, and how many cells they fill."""
        return self.look_codes[looks], self.filled[looks // POSES]

    def mesh(self, look: int, box_m: Float[np.ndarray, "6"]) -> Mesh:
        """A look's surface in a box (centre, full extents)."""
        prototype, pose = divmod(look, POSES)
        surface = self.surface(prototype)
        vertices, faces = surface.vertices_m, surface.faces
        quarters, mirrored = turn_of(pose)
        if mirrored:  # turns its faces inside out: pass their corners the other way
            vertices, faces = vertices * [-1, 1, 1], faces[:, ::-1].copy()
        vertices = vertices @ quarter_rotation(quarters).T
        return Mesh(vertices * box_m[3:] + box_m[:3], faces)

    @property
    def known(self) -> list[int]:
        """The prototypes that there are, by number."""
        return (self.object_class != self.unknown).nonzero()[:, 0].tolist()

    def surface(self, prototype: int) -> Mesh:
        """A prototype's surface in [-0.5, 0.5]^3, found once."""
        if prototype not in self._meshes:
            bits = self.grid_bits[prototype].cpu().numpy()
            filled = np.unpackbits(bits, count=self.cells**3).reshape((self.cells,) * 3)
            surface = surface_of(filled - 0.5, np.zeros(3), np.ones(3), self.margin)
            self._meshes[prototype] = Mesh(*surface)
        return self._meshes[prototype]

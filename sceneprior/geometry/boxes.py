"""Meshes that fill axis-aligned boxes: the beveled cube, and any canonical mesh in its box."""

import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.geometry.corners import CUBE_CORNERS


def beveled_cube(bevels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 32 3"]:
    """The vertices of the cube [-1, 1]^3 with its edges cut off; they still touch all six sides.

    Args:
        bevels: How far the upright and the level edges are cut, in [0, 1] of half a side:
            (0, 0) is the cube, (1, 0) a prism over a diamond, (1, 1) an octahedron.
    """
    upright, level = (1 - bevels).unsqueeze(-2).unbind(dim=-1)
    x, y, z = bevels.new_tensor(CUBE_CORNERS).unbind(dim=-1)
    rings = []
    for across, along in ((x, upright * z), (upright * x, z)):
        across, along = torch.broadcast_tensors(across, along)
        rings.append(torch.stack([across, level * y, along], dim=-1))
        rings.append(torch.stack([level * across, y.expand_as(across), level * along], dim=-1))
    return torch.cat(rings, dim=-2)


def place(
    canonical: Float[Tensor, "rooms objects vertices 3"],
    centers_m: Float[Tensor, "rooms objects 3"],
    sizes_m: Float[Tensor, "rooms objects 3"],
) -> Float[Tensor, "rooms objects vertices 3"]:
    """Move canonical meshes into their boxes: o = M * s / 2 + c.

    The cube [-1, 1]^3 fills the box, so the unit sphere touches all its sides.
    """
    return canonical * (sizes_m / 2).unsqueeze(-2) + centers_m.unsqueeze(-2)

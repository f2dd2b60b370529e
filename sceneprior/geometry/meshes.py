"""Template meshes: the sphere that the shape decoder deforms, the beveled cube; and their boxes."""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.geometry.corners import CUBE_CORNERS


@lru_cache
def _icosphere(level: int) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=level)
    return np.asarray(sphere.vertices), np.asarray(sphere.faces)


def icosphere(level: int) -> tuple[Float[Tensor, "vertices 3"], Int[Tensor, "faces 3"]]:
    """A unit sphere of 20 * 4**level triangles, outward faces; level 4 is the authors'."""
    vertices, faces = _icosphere(level)
    return torch.tensor(vertices, dtype=torch.float32), torch.tensor(faces, dtype=torch.int64)


def to_cube(sphere: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
    """Push a unit sphere's vertices out to the cube [-1, 1]^3, keeping their directions."""
    return sphere / sphere.abs().amax(dim=-1, keepdim=True)


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

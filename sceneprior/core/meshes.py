"""Template meshes: the icosphere that the shape decoder deforms, and the beveled cube."""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.core.boxes import CUBE_CORNERS


@lru_cache
def _icosphere(level: int) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=level)
    return np.asarray(sphere.vertices), np.asarray(sphere.faces)


def icosphere(level: int) -> tuple[Float[Tensor, "vertices 3"], Int[Tensor, "faces 3"]]:
    """Make a unit icosphere of 20 * 4**level outward triangles; the authors use level 4."""
    vertices, faces = _icosphere(level)
    return torch.tensor(vertices, dtype=torch.float32), torch.tensor(faces, dtype=torch.int64)


def to_cube(sphere: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
    """Project a unit sphere's vertices radially onto the cube [-1, 1]^3."""
    return sphere / sphere.abs().amax(dim=-1, keepdim=True)


def beveled_cube(bevels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 32 3"]:
    """Vertices of the cube [-1, 1]^3 with beveled edges; they still touch all six sides.

    `bevels` holds the bevel of the vertical edges and that of the horizontal edges, in half sides,
    [0, 1]: (0, 0) is the cube, (1, 0) a prism over a diamond, and (1, 1) an octahedron.
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
    """Transform canonical meshes into their boxes: o = M * s / 2 + c.

    The cube [-1, 1]^3 fills the box, so the unit sphere touches all six sides of the box.
    """
    return canonical * (sizes_m / 2).unsqueeze(-2) + centers_m.unsqueeze(-2)

"""Template meshes that the shape decoder deforms."""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


@lru_cache
def _icosphere(level: int) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=level)
    return np.asarray(sphere.vertices), np.asarray(sphere.faces)


def icosphere(level: int) -> tuple[Float[Tensor, "vertices 3"], Int[Tensor, "faces 3"]]:
    """A unit sphere of 20 * 4**level triangles, outward faces; level 4 is the authors'."""
    vertices, faces = _icosphere(level)
    return torch.tensor(vertices, dtype=torch.float32), torch.tensor(faces, dtype=torch.int64)


def to_cube(
    sphere: Float[Tensor, "vertices 3"],
) -> Float[Tensor, "vertices 3"]:
    """Push a unit sphere's vertices out to the cube [-1, 1]^3, keeping their directions."""
    return sphere / sphere.abs().amax(dim=-1, keepdim=True)

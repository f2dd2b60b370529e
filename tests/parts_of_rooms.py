"""Small furniture in parts, and the rays that show it, for tests."""

import numpy as np

from sceneprior.core.parts import ACROSS_X, ACROSS_Z, BOX, Parts
from sceneprior.lifted.lifting import RayPool
from sceneprior.lifted.lifting.part_rays import LEVELS, meets


def boxes(*ends, mirrored=()) -> Parts:
    """Boxes between levels, (x1, x2, y1, y2, z1, z2) each."""
    count = len(ends)
    bits = np.array([*mirrored, *[0] * (count - len(mirrored))], dtype=np.int64)
    return Parts(np.full(count, BOX), bits, np.array(ends).reshape(-1, 3, 2) / LEVELS - 0.5)


TABLE = boxes((0, 64, 56, 64, 0, 64), (0, 8, 0, 56, 0, 8), mirrored=(0, ACROSS_X | ACROSS_Z))
CORNER = boxes((0, 64, 0, 24, 0, 64), (0, 16, 24, 64, 0, 64), (16, 64, 24, 40, 0, 20))
"""Without symmetry in any of its poses."""


def rays_of(parts: Parts, count: int, seed: int = 0, margin: float = 1.1) -> RayPool:
    """Random rays through the frame of an object of these parts; half of them hit it, as far as
    there are enough. Rays without information make up the number."""
    rng = np.random.default_rng(seed)
    starts = rng.normal(size=(6 * count, 3))
    starts *= 1.8 / np.linalg.norm(starts, axis=1, keepdims=True)
    spans = rng.uniform(-1, 1, starts.shape) / margin - starts
    spans *= 2
    hits = np.zeros(len(starts), bool)
    scale = margin / 2 * LEVELS
    for kind, bits, ends in zip(*parts[:3], strict=True):
        met = np.empty(len(starts), bool)
        levels = np.rint((ends + 0.5) * LEVELS).astype(np.int64)
        meets(starts * scale + LEVELS / 2, spans * scale, int(kind), int(bits), levels, met)
        hits |= met
    order = rng.permutation(
        np.concatenate([np.flatnonzero(hits)[: count // 2], np.flatnonzero(~hits)[: count // 2]])
    )
    rest = count - len(order)
    starts, spans = (np.pad(part[order], ((0, rest), (0, 0))) for part in (starts, spans))
    return RayPool(starts, spans, np.pad(hits[order], (0, rest)))

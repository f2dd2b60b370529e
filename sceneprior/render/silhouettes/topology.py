"""Edges of a triangle mesh, and the faces at each edge with their orientation."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np


class Topology(NamedTuple):
    """Edges of a mesh.

    `edges`: (edges, 2) vertices, the lower first; `edge_of`: (faces, 3) the edge from each corner
    to the next; `way`: (faces, 3) +1 if the face traverses the edge in this order, else -1.
    """

    edges: np.ndarray
    edge_of: np.ndarray
    way: np.ndarray


def topology_of(faces: np.ndarray) -> Topology:
    """Edges of (faces, 3) triangles; any number of faces may share an edge."""
    return _topology(np.ascontiguousarray(faces, dtype=np.int64).tobytes())


@lru_cache(maxsize=16)
def _topology(data: bytes) -> Topology:
    faces = np.frombuffer(data, dtype=np.int64).reshape(-1, 3)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    edges, edge_of = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    way = np.where(ends[:, 0] < ends[:, 1], 1, -1)
    return Topology(
        edges.astype(np.int32).reshape(-1, 2),
        edge_of.astype(np.int32).reshape(-1, 3),
        way.astype(np.int8).reshape(-1, 3),
    )

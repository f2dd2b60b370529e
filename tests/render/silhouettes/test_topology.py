"""Edges of closed meshes, open meshes and soups."""

import numpy as np
import pytest

from sceneprior.core.geometry.meshes import icosphere
from sceneprior.render.silhouettes.topology import topology_of


def consistent(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How many faces meet at each edge and the sum of their ways, after reading every corner."""
    mesh = topology_of(faces)
    assert mesh.edges.dtype == mesh.edge_of.dtype == np.int32 and mesh.way.dtype == np.int8
    assert mesh.edge_of.shape == mesh.way.shape == faces.shape
    assert (mesh.edges[:, 0] <= mesh.edges[:, 1]).all()
    assert len(np.unique(mesh.edges, axis=0)) == len(mesh.edges)
    meet, ways = np.zeros(len(mesh.edges), int), np.zeros(len(mesh.edges), int)
    for face, corners in enumerate(faces):
        for k in range(3):
            ends = (corners[k], corners[(k + 1) % 3])
            way = int(mesh.way[face, k])
            assert tuple(mesh.edges[mesh.edge_of[face, k]])[::way] == ends
            meet[mesh.edge_of[face, k]] += 1
            ways[mesh.edge_of[face, k]] += way
    return meet, ways


@pytest.mark.parametrize("level", [0, 1, 2])
def test_two_faces_meet_at_every_edge_of_a_sphere_and_run_against_each_other(level):
    vertices, faces = icosphere(level)
    meet, ways = consistent(faces.numpy())
    assert len(meet) == 3 * len(vertices) - 6  # Euler
    assert (meet == 2).all() and (ways == 0).all()


def test_the_rim_of_an_open_mesh_has_one_face():
    vertices, faces = icosphere(1)
    half = faces[(vertices[faces][:, :, 2] > -1e-6).all(dim=1)].numpy()
    meet, ways = consistent(half)
    rim = meet == 1
    assert 0 < rim.sum() < len(meet) and (np.abs(ways[rim]) == 1).all()
    assert (meet[~rim] == 2).all() and (ways[~rim] == 0).all()
    mesh = topology_of(half)
    ends, times = np.unique(mesh.edges[rim], return_counts=True)
    assert (times == 2).all() and len(ends) == rim.sum()  # it closes


def test_three_faces_at_one_edge():
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    meet, ways = consistent(faces)
    mesh = topology_of(faces)
    shared = mesh.edge_of[0, 0]
    assert mesh.edges[shared].tolist() == [0, 1]
    assert (mesh.edge_of[:, 0] == shared).all() and mesh.way[:, 0].tolist() == [1, -1, 1]
    assert meet[shared] == 3 and ways[shared] == 1 and meet.sum() == 9
    assert len(mesh.edges) == 7


def test_no_faces_have_no_edges():
    mesh = topology_of(np.zeros((0, 3), dtype=np.int64))
    assert mesh.edges.shape == (0, 2) and mesh.edge_of.shape == mesh.way.shape == (0, 3)


def test_a_topology_is_found_once_whatever_the_faces_type():
    faces = icosphere(1)[1].numpy()
    assert topology_of(faces) is topology_of(faces.astype(np.int32).copy(order="F"))
    assert topology_of(faces) is not topology_of(faces[::-1])

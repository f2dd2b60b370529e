"""Rays, points inside, meeting triangles and voxels, beside plain twins and trimesh."""

import numpy as np
import pytest
import trimesh
from references.surfaces import triangles_meet, winding

from sceneprior.core.scene import SceneObject
from sceneprior.evaluation.surfaces import (
    edge_hits,
    inside,
    meeting_pairs,
    triangles_of,
    vertical_crossings,
    voxelize,
)


def blob() -> np.ndarray:
    """Two closed bodies that overlap, as triangles."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.6)
    tube = trimesh.creation.cylinder(radius=0.3, height=2.0)
    return np.concatenate([ball.triangles, tube.triangles])


def test_points_are_inside_where_the_winding_number_is_not_zero(rng):
    surface = blob()
    points = rng.uniform(-0.9, 0.9, (120, 3))
    by_hand = [abs(winding(point, surface)) > 0.5 for point in points]
    assert 10 < sum(by_hand) < 110
    assert inside(points, surface).tolist() == by_hand
    assert inside(points, surface[:, ::-1]).tolist() == by_hand  # all triangles turned over


def test_lines_through_shared_edges_cross_a_box_twice():
    box = triangles_of(SceneObject("desk", (0.0, 0.5, 0.0), (1.0, 1.0, 1.0)))
    found = vertical_crossings(np.array([[0.0, 5.0, 0.0], [0.25, 5.0, 0.25]]), box)
    assert np.bincount(found.point).tolist() == [2, 2]
    assert sorted(found.height_m[found.point == 0]) == [0.0, 1.0]
    assert found.side[np.argsort(found.height_m)].tolist() == [-1, -1, 1, 1]


def test_triangles_meet_where_an_edge_passes_through(rng):
    a, b = rng.uniform(-1, 1, (2, 40, 3, 3))
    by_hand = {(i, j) for i in range(40) for j in range(40) if triangles_meet(a[i], b[j])}
    pairs = meeting_pairs(a, b)
    assert len(by_hand) > 50 and {tuple(pair) for pair in pairs.tolist()} == by_hand
    hits = edge_hits(a[pairs[:, 0]], b[pairs[:, 1]])
    assert len(hits) == 2 * len(pairs)  # a segment has two ends


def test_coplanar_triangles_meet_only_if_they_overlap():
    flat = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 0, 1]]])
    assert len(meeting_pairs(flat, flat)) == 1
    assert len(meeting_pairs(flat, flat + np.array([0.9, 0, 0]))) == 1
    assert len(meeting_pairs(flat, flat + np.array([0.6, 0, 0.6]))) == 0
    assert len(meeting_pairs(flat, flat + np.array([0, 1e-9, 0]))) == 0


@pytest.mark.parametrize("pitch_m", [0.05, 0.11])
def test_voxels_are_those_of_trimesh(pitch_m):
    for mesh in (
        trimesh.creation.icosphere(subdivisions=2, radius=0.43),
        trimesh.creation.box((0.61, 0.37, 1.03)),
        trimesh.creation.cylinder(radius=0.21, height=0.83),
    ):
        theirs = mesh.voxelized(pitch_m).fill()
        ours = voxelize(np.asarray(mesh.triangles), pitch_m)
        assert ours.cells.shape == theirs.matrix.shape
        assert np.allclose(ours.first * pitch_m, theirs.translation)
        # Points of the two divisions differ, so cells that a surface cuts at a corner may.
        assert (ours.cells != theirs.matrix).mean() < 0.02

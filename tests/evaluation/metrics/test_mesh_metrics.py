"""Surfaces and turned boxes against closed forms, trimesh and brute force."""

import itertools

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Mesh
from sceneprior.core.surfaces import chamfer_of, nearest_distances
from sceneprior.evaluation.view_scores import f_score, sample_surface, upright_box_iou_3d
from sceneprior.render.appearance import box_mesh


def random_boxes(rng: np.random.Generator, count: int) -> list[trimesh.Trimesh]:
    """Upright boxes, turned about the vertical axis."""
    boxes = []
    for _ in range(count):
        turn = trimesh.transformations.rotation_matrix(rng.uniform(-np.pi, np.pi), [0, 1, 0])
        turn[:3, 3] = rng.uniform(-0.5, 0.5, 3)
        boxes.append(trimesh.creation.box(rng.uniform(0.3, 1.5, 3), transform=turn))
    return boxes


def plain(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def test_points_lie_on_the_surface_and_are_spread_by_area():
    points = sample_surface(box_mesh((1.0, 2.0, 3.0), (4.0, 1.0, 2.0)), 40_000, seed=0)
    own = np.abs(points - [1, 2, 3]) / [2, 0.5, 1]
    on_side = np.isclose(own, 1, atol=1e-9)
    assert (own <= 1 + 1e-9).all() and on_side.any(axis=1).all()
    # Sides of 2 x 2, 2 x 8 and 2 x 4 square metres; five standard deviations of a share.
    shares = on_side.mean(axis=0)
    np.testing.assert_allclose(shares, np.array([4, 16, 8]) / 28, atol=5 * 0.5 / 200)
    np.testing.assert_allclose(points.mean(axis=0), [1, 2, 3], atol=5 * 2 / 200)


def test_a_mesh_without_faces_has_no_points():
    with pytest.raises(InputError, match="without faces has no surface"):
        sample_surface(Mesh(np.zeros((3, 3)), np.zeros((0, 3), int)), 10, 0)


def test_chamfer_and_f_score_are_the_definition(rng):
    a, b = rng.normal(size=(70, 3)), rng.normal(size=(50, 3))
    apart = cdist(a, b)
    there, back = apart.min(axis=1), apart.min(axis=0)
    found = chamfer_of(*nearest_distances(a, b))
    assert found.l2_m == pytest.approx(there.mean() + back.mean(), rel=1e-12)
    assert found.squared_m2 == pytest.approx((there**2).mean() + (back**2).mean(), rel=1e-12)
    precision, recall = (there <= 0.4).mean(), (back <= 0.4).mean()
    expected = 2 * precision * recall / (precision + recall)
    assert f_score(*nearest_distances(a, b), 0.4) == pytest.approx(expected, rel=1e-12)


def test_turned_boxes_share_what_trimesh_says(rng):
    overlapping = 0
    for a, b in itertools.product(random_boxes(rng, 6), random_boxes(rng, 5)):
        shared = shared_volume(a, b)
        expected = shared / (a.volume + b.volume - shared)
        assert upright_box_iou_3d(plain(a), plain(b)) == pytest.approx(expected, abs=1e-9)
        overlapping += expected > 0.1
    assert overlapping > 5
    flat = Mesh(np.array([[0.0, 0, 1], [0, 2, 1], [0, 2, 3]]), np.array([[0, 1, 2]]))
    assert upright_box_iou_3d(flat, flat) == 0


def shared_volume(one: trimesh.Trimesh, other: trimesh.Trimesh) -> float:
    """Volume of the intersection of two convex meshes, cut off plane by plane."""
    rest = one
    for origin, normal in zip(other.triangles_center, other.face_normals, strict=True):
        rest = rest.slice_plane(origin, -normal)
        if rest.is_empty:
            return 0.0
        rest = rest.convex_hull
    return float(rest.volume)

"""Surfaces and turned boxes against closed forms, trimesh and brute force."""

import itertools

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Mesh
from sceneprior.core.surfaces import chamfer_of, nearest_distances
from sceneprior.evaluation.view_scores import (
    OrientedBox,
    f_score,
    oriented_box,
    oriented_box_iou_3d,
    sample_surface,
)
from sceneprior.render.appearance import box_mesh


def random_boxes(rng: np.random.Generator, count: int) -> list[OrientedBox]:
    centers, sizes = rng.uniform(-0.5, 0.5, (count, 3)), rng.uniform(0.3, 1.5, (count, 3))
    yaws = rng.uniform(-np.pi, np.pi, count).tolist()
    return [OrientedBox(*row) for row in zip(centers, sizes, yaws, strict=True)]


def solid(box: OrientedBox) -> trimesh.Trimesh:
    turn = trimesh.transformations.rotation_matrix(box.yaw_rad, [0, 1, 0])
    turn[:3, 3] = box.center_m
    return trimesh.creation.box(box.size_m, transform=turn)


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
        one, other = solid(a), solid(b)
        shared = shared_volume(one, other)
        expected = shared / (one.volume + other.volume - shared)
        assert oriented_box_iou_3d(a, b) == pytest.approx(expected, abs=1e-9)
        overlapping += expected > 0.1
    assert overlapping > 5


def shared_volume(one: trimesh.Trimesh, other: trimesh.Trimesh) -> float:
    """Volume of the intersection of two convex meshes, cut off plane by plane."""
    rest = one
    for origin, normal in zip(other.triangles_center, other.face_normals, strict=True):
        rest = rest.slice_plane(origin, -normal)
        if rest.is_empty:
            return 0.0
        rest = rest.convex_hull
    return float(rest.volume)


def test_the_tightest_box_of_a_turned_box_is_itself(rng):
    for box in random_boxes(rng, 20):
        mesh = solid(box)
        found = oriented_box(Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)))
        assert oriented_box_iou_3d(found, box) == pytest.approx(1, abs=1e-9)
        assert 0 <= found.yaw_rad < np.pi / 2

"""Points on meshes: on the surface, even by area, and even in every part of them."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from sceneprior.core.surfaces import chamfer_mean, surface_points


def test_points_lie_on_the_mesh_and_go_by_their_seed():
    mesh = trimesh.creation.icosphere(2)
    points = surface_points(mesh.vertices, mesh.faces, 500, seed=4)
    _, apart, _ = trimesh.proximity.closest_point_naive(mesh, points)
    assert apart.max() < 1e-9
    np.testing.assert_array_equal(points, surface_points(mesh.vertices, mesh.faces, 500, seed=4))
    assert np.abs(points - surface_points(mesh.vertices, mesh.faces, 500, seed=5)).max() > 1e-3


@pytest.mark.parametrize("step", [1, 4, 16])
def test_every_part_covers_the_surface_by_area(step):
    """Two squares of areas 1 and 3, a face of them split in two; and a face without area."""
    vertices = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1], [0, 5, 0], [3, 5, 0], [3, 5, 1], [0, 5, 1.0]]
    )
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 1, 2], [4, 5, 6], [4, 6, 7]])
    points = surface_points(vertices, faces, 1024)[::step]
    few = points[:, 1] == 0
    # Pieces of equal area are cut in order of the faces: the count is exact to one point.
    assert abs(few.sum() - len(points) / 4) <= 1
    # Within a face places are random: the mean of n points strays by side / sqrt(12 n).
    for part, middle in ((few, [0.5, 0, 0.5]), (~few, [1.5, 5, 0.5])):
        bound = 4 * 3 / np.sqrt(12 * part.sum())
        np.testing.assert_allclose(points[part].mean(axis=0), middle, atol=bound)


def test_a_triangle_is_filled_evenly():
    points = surface_points(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]), 20000
    )
    assert (points[:, :2] >= 0).all() and (points.sum(axis=1) <= 1 + 1e-12).all()
    # Moments of a uniform point of this triangle: mean 1/3, variance 1/18, covariance -1/36.
    np.testing.assert_allclose(points.mean(axis=0), [1 / 3, 1 / 3, 0], atol=0.006)
    covariance = np.cov(points[:, :2].T)
    np.testing.assert_allclose(covariance, [[1 / 18, -1 / 36], [-1 / 36, 1 / 18]], atol=0.002)


@pytest.mark.parametrize("scale", [0.0, np.nan, np.inf])
def test_meshes_without_area_are_refused(scale):
    mesh = trimesh.creation.box()
    with np.errstate(all="ignore"), pytest.raises(ValueError, match="no area"):
        surface_points(mesh.vertices * scale, mesh.faces, 8)
    with pytest.raises(ValueError, match="no area"):
        surface_points(mesh.vertices, np.zeros((0, 3), np.int64), 8)


def test_the_mean_chamfer_distance_is_its_definition(rng):
    a, b = rng.normal(size=(70, 3)), rng.normal(size=(50, 3))
    apart = np.linalg.norm(a[:, None] - b[None], axis=2)
    by_hand = (apart.min(axis=1).mean() + apart.min(axis=0).mean()) / 2
    assert chamfer_mean(a, b) == pytest.approx(by_hand, rel=1e-12)
    assert chamfer_mean(a, b, cKDTree(a)) == chamfer_mean(a, b)
    # Two parallel unit squares, sampled at the same places: nearer than neighbours are.
    square = np.column_stack([rng.random((40, 2)), np.zeros(40)])
    assert chamfer_mean(square, square + np.array([0, 0, 0.01])) == pytest.approx(0.01, rel=1e-9)

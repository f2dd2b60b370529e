"""Surfaces of occupancy grids, points on surfaces, and Chamfer distances."""

from collections import Counter

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from sceneprior.core.surfaces import chamfer_of, nearest_distances, surface_of, surface_points

CENTER, SIZE = np.array([1.0, 2.0, -3.0]), np.array([2.0, 1.0, 0.5])


def frame_points(cells=32, margin=1.1):
    """Centres of the cells in metres from the box's centre, indexed x, y, z."""
    axis = ((np.arange(cells) + 0.5) / cells - 0.5) * margin
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1) * SIZE


def is_closed(faces) -> bool:
    """True if each edge is passed as often in one direction as in the other."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()
    there, back = Counter(map(tuple, edges)), Counter((b, a) for a, b in map(tuple, edges))
    return there == back


def block(low, high, cells=32, margin=1.1):
    """Logits of a block, in metres from the box's centre; they change by at most 3 a cell."""
    points = frame_points(cells, margin)
    depth = np.minimum(points - low, np.array(high) - points).min(axis=-1)
    return 40 * depth


@pytest.mark.parametrize("noise", [0.0, 6.0])
def test_surfaces_are_closed_outward_and_of_few_faces(rng, noise):
    ball = 4 - 10 * np.linalg.norm(frame_points() / SIZE, axis=-1)
    ball += noise * (rng.random(ball.shape) - 0.5)
    vertices, faces = surface_of(ball.astype(np.float32), CENTER, SIZE, 1.1)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert len(faces) <= 2000 and is_closed(faces) and mesh.volume > 0
    assert len(np.unique(faces)) == len(vertices)
    if not noise:
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.4**3 * SIZE.prod(), rel=0.01)


def test_small_pieces_are_dropped_and_large_ones_stay():
    def with_piece(size):
        piece = block([0.5, 0.2, 0.1], np.array([0.5, 0.2, 0.1]) + size)
        both = np.maximum(block([-0.8, -0.4, -0.2], [0.2, 0.1, 0.05]), piece)
        return surface_of(both, CENTER, SIZE, 1.1)[0]

    assert with_piece(np.array([0.1, 0.1, 0.1]))[:, 0].max() < CENTER[0] + 0.21
    assert with_piece(np.array([0.4, 0.25, 0.13]))[:, 0].max() > CENTER[0] + 0.85


@pytest.mark.parametrize("logit", [-1.0, 0.0, 2.0])
def test_nothing_and_everything_are_the_box(logit):
    vertices, faces = surface_of(np.full((8, 8, 8), logit), CENTER, SIZE, 1.1)
    np.testing.assert_allclose(vertices.min(axis=0), CENTER - SIZE / 2)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(SIZE.prod())
    # What is occupied in the margin alone is outside the box.
    logits = np.full((8, 8, 8), -1.0)
    logits[0] = 1.0
    assert len(surface_of(logits, CENTER, SIZE, 2.0)[0]) == 8


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


@pytest.mark.parametrize("scale", [0.0, np.nan, np.inf])
def test_meshes_without_area_are_refused(scale):
    mesh = trimesh.creation.box()
    with np.errstate(all="ignore"), pytest.raises(ValueError, match="no area"):
        surface_points(mesh.vertices * scale, mesh.faces, 8)
    with pytest.raises(ValueError, match="no area"):
        surface_points(mesh.vertices, np.zeros((0, 3), np.int64), 8)


def test_the_chamfer_distance_is_its_definition(rng):
    def chamfer(*points) -> float:
        return chamfer_of(*nearest_distances(*points)).l2_m

    a, b = rng.normal(size=(70, 3)), rng.normal(size=(50, 3))
    apart = np.linalg.norm(a[:, None] - b[None], axis=2)
    by_hand = apart.min(axis=1).mean() + apart.min(axis=0).mean()
    assert chamfer(a, b) == pytest.approx(by_hand, rel=1e-12)
    assert chamfer(a, b, cKDTree(a)) == chamfer(a, b)
    # Two parallel unit squares, sampled at the same places: nearer than neighbours are.
    square = np.column_stack([rng.random((40, 2)), np.zeros(40)])
    assert chamfer(square, square + np.array([0, 0, 0.01])) == pytest.approx(0.02, rel=1e-9)

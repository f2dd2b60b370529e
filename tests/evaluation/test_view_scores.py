"""Scores of matched objects by hand; surfaces and turned boxes beside trimesh and brute force."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist

from sceneprior.core.scene import Mesh, SceneObject
from sceneprior.core.surfaces import chamfer_of, nearest_distances
from sceneprior.evaluation.view_scores import (
    f_score,
    score_pair,
    score_views,
    upright_box_iou_3d,
)
from sceneprior.render.appearance import box_mesh

POINTS = 4000


def solid(label, center_m, size_m) -> SceneObject:
    return SceneObject(label, center_m, size_m, box_mesh(center_m, size_m))


DESK = solid("desk", (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
BED = solid("double_bed", (2.0, 0.5, 0.0), (2.0, 1.0, 2.0))


def moved(item: SceneObject, x_m: float) -> SceneObject:
    x, y, z = item.center_m
    return solid(item.label, (x + x_m, y, z), item.size_m)


def test_a_box_is_no_surface():
    """A true object without a mesh is compared by box and class; its other scores are None, and the
    scores of other objects stay the same."""
    score = score_pair((replace(DESK, mesh=None), moved(DESK, 0.5)), POINTS)
    assert (score["box_iou_3d"], score["class_accuracy"]) == (pytest.approx(1 / 3), True)
    unknown = ("oriented_box_iou_3d", "chamfer_l2_m", "chamfer_squared_m2", "f_score")
    assert all(score[name] is None for name in unknown)
    assert score_pair((replace(DESK, mesh=None), None), POINTS)["f_score"] is None
    mixed = [[(BED, moved(BED, 0.1)), (replace(DESK, mesh=None), DESK)]]
    one, two = (score_views(v, ["a"], POINTS)["summary"] for v in (mixed, [mixed[0][:1]]))
    assert (one["objects"], one["with_surface"], two["with_surface"]) == (2, 1, 1)
    assert all(one[name] == two[name] for name in unknown)
    bare = score_views([mixed[0][1:]], ["a"], POINTS)["summary"]
    assert bare["with_surface"] == 0 and all(bare[name] is None for name in unknown)


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

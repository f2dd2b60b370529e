"""Wireframes and boxes in the image, compared with corners projected by hand."""

import numpy as np
import pytest

from data_prep.front.viewpoints import camera_pose
from data_prep.inspection import projection
from data_prep.inspection.projection import Hull, box_iou_2d, boxes_around, hull_of, wire_pixels
from sceneprior.core.geometry.corners import BOX_EDGES, box_corners

K = np.array([[100.0, 0, 60], [0, 100, 45], [0, 0, 1]])


def test_wires_join_projected_points(numbers):
    camera = camera_pose(np.array([0.3, 1.5, -3.0]), 0.2, 0.3)
    points = box_corners(numbers.normal(size=3) * 0.2, np.array([1.0, 0.5, 0.8]))
    here = points @ camera[:3, :3].T + camera[:3, 3]
    assert here[:, 2].min() > 0.5
    pixels = here @ K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    for line, (a, b) in zip(wire_pixels(points, BOX_EDGES, camera, K), BOX_EDGES, strict=True):
        np.testing.assert_allclose(line, [*pixels[a], *pixels[b]], atol=1e-5)  # rounded to 1e-6
    (box,) = boxes_around(hull_of(points), camera[None], K[None])
    np.testing.assert_allclose(box, [*pixels.min(axis=0), *pixels.max(axis=0)], atol=1e-9)


@pytest.mark.parametrize("turned", [False, True])
def test_a_line_through_the_camera_is_cut_where_it_becomes_visible(turned):
    line = np.array([[0.0, 0.1, -2.0], [0.0, 0.1, 2.0]])[:: -1 if turned else 1]
    ((u1, v1, u2, v2),) = wire_pixels(line, [(0, 1)], np.eye(4), K)
    ends = [(u1, v1), (u2, v2)][:: -1 if turned else 1]
    assert ends[0] == pytest.approx((60, 45 + 100 * 0.1 / projection.WIRE_NEAR_M))
    assert ends[1] == pytest.approx((60, 50))
    assert wire_pixels(-np.abs(line), [(0, 1)], np.eye(4), K) == []
    hull = Hull(line, np.array([[0, 1]]))
    (box,) = boxes_around(hull, np.eye(4)[None], K[None])
    assert sorted(box) == pytest.approx(sorted([u1, v1, u2, v2]))
    behind = hull._replace(points_m=-np.abs(line))
    assert np.isnan(boxes_around(behind, np.eye(4)[None], K[None])).all()


def test_a_hull_projects_as_all_of_its_points_do(numbers):
    points = numbers.normal(size=(500, 3)) * (1.0, 0.5, 0.1)
    hull = hull_of(points)
    assert len(hull.points_m) < 150
    near = camera_pose(np.array([0.0, 0.1, -0.6]), 0.0, 0.1)  # some points lie behind it
    for camera in (camera_pose(np.array([0.3, 1.5, -3.0]), 0.2, 0.3), near):
        here = points @ camera[:3, :3].T + camera[:3, 3]
        # All lines between points, cut at the near plane: slow, and the same.
        a, b = (here[rows] for rows in np.triu_indices(len(here), 1))
        cross = (a[:, 2] < projection.WIRE_NEAR_M) != (b[:, 2] < projection.WIRE_NEAR_M)
        a, b = a[cross], b[cross]
        cut = a + (b - a) * ((projection.WIRE_NEAR_M - a[:, 2:]) / (b[:, 2:] - a[:, 2:]))
        seen = np.concatenate([here[here[:, 2] >= projection.WIRE_NEAR_M], cut]) @ K.T
        pixels = seen[:, :2] / seen[:, 2:]
        (box,) = boxes_around(hull, camera[None], K[None])
        np.testing.assert_allclose(box, [*pixels.min(axis=0), *pixels.max(axis=0)], rtol=1e-6)


@pytest.mark.parametrize("flat", [(1, 0, 1), (1, 1, 0), (0, 0, 1), (0, 0, 0)])
def test_flat_things_have_a_hull(flat, numbers):
    points = numbers.normal(size=(30, 3)) * flat
    hull = hull_of(points)
    np.testing.assert_allclose(hull.points_m.min(axis=0), points.min(axis=0), atol=1e-9)
    np.testing.assert_allclose(hull.points_m.max(axis=0), points.max(axis=0), atol=1e-9)


def test_overlap_of_boxes():
    unit = np.array([0.0, 0, 1, 1])
    for other, expected in (
        (unit, 1.0), ([0.5, 0, 1.5, 1], 1 / 3), ([1, 0, 2, 1], 0.0), ([3, 3, 4, 4], 0.0),
        ([0.25, 0.25, 0.75, 0.75], 0.25),
    ):  # fmt: skip
        assert box_iou_2d(unit, np.array(other)) == pytest.approx(expected, abs=1e-15)
    assert np.isnan(box_iou_2d(unit, np.full(4, np.nan)))

"""The z-buffer against hand-computed pictures and a slow, obvious ray caster."""

import numpy as np
import pytest

from sceneprior.render.offscreen.zbuffer import rasterize

IDENTITY = np.eye(4)
LENS = (8.0, 8.0, 8.0, 8.0)


def cast_rays(vertices, faces, projection, image_size, near_m=0.01):
    """Intersect the ray of every pixel centre with every triangle, one at a time, in float64."""
    fx, fy, cx, cy = projection
    index = np.full(image_size, -1)
    depth = np.full(image_size, np.inf)
    for row in range(image_size[0]):
        for column in range(image_size[1]):
            ray = np.array([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1.0])
            for face, (a, b, c) in enumerate(vertices[faces]):
                system = np.column_stack([b - a, c - a, -ray])
                if abs(np.linalg.det(system)) < 1e-12:
                    continue
                s, t, z = np.linalg.solve(system, -a)
                if s >= 0 and t >= 0 and s + t <= 1 and near_m <= z < depth[row, column]:
                    index[row, column], depth[row, column] = face, z
    return index, depth


def draw_one_pixel_at_a_time(vertices, faces, projection, image_size):
    """The z-buffer's own arithmetic, face by face and pixel by pixel, for what lies in front."""
    fx, fy, cx, cy = projection
    index = np.full(image_size, -1, dtype=np.int32)
    nearness = np.full(image_size, -np.inf, dtype=np.float32)
    inverse = 1.0 / vertices[:, 2]
    u = fx * vertices[:, 0] * inverse + cx
    v = fy * vertices[:, 1] * inverse + cy
    for face, (a, b, c) in enumerate(faces):
        area = (u[b] - u[a]) * (v[c] - v[a]) - (v[b] - v[a]) * (u[c] - u[a])
        if abs(area) <= 1e-12:
            continue
        for row, column in np.ndindex(image_size):
            x, y = column + 0.5 - u[a], row + 0.5 - v[a]
            in_box = u[[a, b, c]].min() <= column + 0.5 <= u[[a, b, c]].max()
            weight_b = (v[c] - v[a]) / area * x + -(u[c] - u[a]) / area * y
            weight_c = -(v[b] - v[a]) / area * x + (u[b] - u[a]) / area * y
            if not in_box or min(weight_b, weight_c) < -1e-9 or weight_b + weight_c > 1 + 1e-9:
                continue
            slope_b, slope_c = inverse[b] - inverse[a], inverse[c] - inverse[a]
            near = np.float32(inverse[a] + weight_b * slope_b + weight_c * slope_c)
            if near > nearness[row, column]:
                index[row, column], nearness[row, column] = face, near
    return index, nearness


@pytest.mark.parametrize("width", [1, 2, 3, 5, 19])
def test_narrow_and_wide_triangles_are_drawn_to_the_bit(width):
    """Most are narrower than five pixels, as in a furnished room, and many leave the picture."""
    rng = np.random.default_rng(width)
    size_px = rng.choice([0.7, 2, 5, 20], (70, 1, 1))
    corners = rng.uniform((-2, -2), (width + 2, 11), (70, 1, 2)) + rng.normal(size=(70, 3, 2)) * (
        size_px / 2
    )
    depth = rng.choice([2.0, 3.0, 4.0], (70, 1, 1)) + rng.uniform(0, 0.5, (70, 3, 1))
    depth[::3] = 2.5  # parallel to the picture: two such faces are equally near
    vertices = np.concatenate([(corners - (3, 4)) / 8 * depth, depth], axis=-1).reshape(-1, 3)
    faces = np.arange(210).reshape(70, 3)
    projection = (8.0, 8.0, 3.0, 4.0)
    by_hand, nearness = draw_one_pixel_at_a_time(vertices, faces, projection, (9, width))
    index, depth = rasterize(vertices, faces, IDENTITY, projection, (9, width))
    np.testing.assert_array_equal(index, by_hand)
    with np.errstate(divide="ignore"):
        np.testing.assert_array_equal(depth[index >= 0], 1 / nearness[index >= 0])
    labels = rng.integers(1, 500, 70).astype(np.int32)
    drawn, _ = rasterize(vertices, faces, IDENTITY, projection, (9, width), labels=labels)
    np.testing.assert_array_equal(drawn, np.where(by_hand < 0, -1, labels[by_hand]))


def test_matches_ray_casting():
    rng = np.random.default_rng(3)
    # Around the camera, too: many triangles cross the near plane.
    vertices = rng.uniform((-2, -2, -1), (2, 2, 3), (60, 3))
    faces = np.arange(60).reshape(20, 3)
    projection = (20.0, 22.0, 16.5, 11.0)
    index, depth = rasterize(vertices, faces, IDENTITY, projection, (24, 32))
    by_hand, depth_by_hand = cast_rays(vertices, faces, projection, (24, 32))
    np.testing.assert_array_equal(index, by_hand)
    seen = by_hand >= 0
    assert seen.mean() > 0.2
    np.testing.assert_allclose(depth[seen], depth_by_hand[seen], rtol=2e-6)  # float32 nearness
    assert np.isinf(depth[~seen]).all()
    assert index.dtype == np.int32 and depth.dtype == np.float32


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_broken_vertices_draw_nothing_and_spoil_nothing(bad):
    vertices = np.array([[-1.0, -1, 1], [1, -1, 1], [0, 1, 1], [bad, 0, 1], [0, bad, 1], [0, 0, 0]])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    good, _ = rasterize(vertices[:3], faces[:1], IDENTITY, LENS, (16, 16))
    index, _ = rasterize(vertices, faces, IDENTITY, LENS, (16, 16))
    np.testing.assert_array_equal(index[good >= 0], 0)

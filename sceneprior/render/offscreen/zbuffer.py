"""A z-buffer of triangles, sampled at pixel centres, and soft shadows under light from the sky."""

import math

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from sceneprior.core.cameras import Pinhole, rigid

DIRECTIONS = 128
"""Number of directions towards the sky in which light is tested for occlusion. With 24, the floor
shows the outline of each single shadow."""
MAP_PX = 192
"""Side in pixels of the depth map that is drawn for each direction."""
BIAS_M = 0.02
"""Minimum distance of an occluder from the surface that it shades, so that no surface shades
itself."""
DARKEST = 0.45
"""Brightness of a surface that no light from the sky reaches."""


def sky_light(
    vertices_m: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    camera: Pinhole,
    depth_m: Float[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Brightness in [`DARKEST`, 1] of each pixel, linear in the share of unoccluded sky directions.

    Pixels that show nothing have brightness 1. `depth_m` is the depth at the middle of each pixel's
    upper left quarter.
    """
    light = np.ones(depth_m.shape)
    rows, columns = np.nonzero(np.isfinite(depth_m))
    if not len(rows):
        return light
    focal, middle = camera.intrinsics[[0, 1], [0, 1]], camera.intrinsics[:2, 2]
    depth = depth_m[rows, columns].astype(np.float64)
    across = (np.stack([columns, rows], axis=1) + 0.25 - middle) / focal * depth[:, None]
    turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    points_m = (np.hstack([across, depth[:, None]]) - shift) @ turn
    shown = np.unique(faces)
    middle_m = (vertices_m[shown].min(axis=0) + vertices_m[shown].max(axis=0)) / 2
    reach_m = np.linalg.norm(np.ptp(vertices_m[shown], axis=0)) / 2 + 0.1
    scale = float(MAP_PX / (2 * reach_m))
    open_sky = np.zeros(len(points_m), dtype=np.int64)
    for towards in _directions():
        side = np.cross([0.0, 0.0, 1.0], towards)
        side /= np.linalg.norm(side)
        rotation = np.stack([side, np.cross(-towards, side), -towards])
        pose = rigid(rotation, [0, 0, 2 * reach_m] - rotation @ middle_m)
        projection = (scale, scale, MAP_PX / 2, MAP_PX / 2)
        _, nearest = rasterize(vertices_m, faces, pose, projection, (MAP_PX, MAP_PX), False)
        # Within one pixel of the map, the depth of the floor varies by its slope over the scale. A
        # slope of at least 45 degrees is assumed, since other surfaces are steeper than the floor.
        slope = max(1.0, np.hypot(towards[0], towards[2]) / towards[1])
        _count_unoccluded(points_m, pose, scale, nearest, BIAS_M + slope / scale, open_sky)
    light[rows, columns] = DARKEST + (1 - DARKEST) * open_sky / DIRECTIONS
    return light


@njit(cache=True, nogil=True)
def _count_unoccluded(points_m, pose, scale, nearest_m, bias_m, count):
    """Count one more open direction for each point that is not occluded in an orthographic depth
    map."""
    m, side = pose, len(nearest_m)
    for i in range(len(points_m)):
        x, y, z = points_m[i, 0], points_m[i, 1], points_m[i, 2]
        u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) * scale + side / 2
        v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) * scale + side / 2
        depth_m = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        column, row = min(max(int(u), 0), side - 1), min(max(int(v), 0), side - 1)
        count[i] += depth_m <= nearest_m[row, column] + bias_m


def _directions() -> Float[np.ndarray, "directions 3"]:
    """Unit vectors of the upper hemisphere, on a spiral, with a density per solid angle that is
    proportional to the cosine of their angle with the vertical."""
    order = (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    flat, turn = np.sqrt(order), np.arange(DIRECTIONS) * np.pi * (3 - np.sqrt(5))
    return np.stack([flat * np.cos(turn), np.sqrt(1 - order), flat * np.sin(turn)], axis=1)


NEAR_PLANE_M = 0.01
"""Depth of the near plane, at which triangles are clipped."""

# Tolerance on barycentric weights, so that rounding leaves no gap at a pixel centre on the edge
# between two faces.
_SLACK = 1e-9

# Triangles of at most this width, which are most of a furnished room's, are drawn without a branch
# per pixel: a mispredicted branch takes longer than four pixels.
_NARROW_PX = 4


def rasterize(
    vertices: np.ndarray,
    faces: np.ndarray,
    world_to_camera: np.ndarray,
    projection: tuple[float, float, float, float],
    image_size: tuple[int, int],
    perspective: bool = True,
    labels: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw triangles into a z-buffer, sampled at pixel centres.

    Both sides of a triangle are drawn. A pixel centre on an edge belongs to the triangle. Among
    equally near faces, the one with the lowest index is drawn, so the picture is deterministic.

    Args:
        vertices: (V, 3) world positions in metres.
        faces: (F, 3) corners of each triangle, as indices into `vertices`.
        world_to_camera: (4, 4), OpenCV axes (x right, y down, z forward).
        projection: fx, fy, cx, cy with u = fx * x / z + cx (perspective) or u = fx * x + cx
            (orthographic, fx in pixels per metre); v likewise from y.
        labels: (F,) non-negative label of each triangle; None uses the triangle's index.

    Returns:
        label: (height, width) int32, -1 at pixels without a triangle.
        depth: (height, width) float32, z in metres along the optical axis; inf without a triangle.

    Example: a wall 2 m away, left of the axis, fills the left half of the picture.

        >>> wall = np.array([[-9.0, -9, 2], [0, -9, 2], [0, 9, 2], [-9, 9, 2]])
        >>> faces = np.array([[0, 1, 2], [0, 2, 3]])
        >>> index, depth = rasterize(wall, faces, np.eye(4), (4.0, 4.0, 2.0, 2.0), (4, 4))
        >>> depth[0].tolist()
        [2.0, 2.0, inf, inf]
    """
    height, width = image_size
    pixels = height * width
    # Flat, and a few pixels longer than the image, since `_fill` reads past a row's end.
    image = np.full(pixels + _NARROW_PX - 1, -1, dtype=np.int32)
    # 1 / z, or -z for an orthographic camera; both are linear in screen space over a triangle.
    nearness = np.full(pixels + _NARROW_PX - 1, -np.inf, dtype=np.float32)
    fx, fy, cx, cy = (float(value) for value in projection)
    _draw(
        np.ascontiguousarray(vertices, dtype=np.float64),
        np.ascontiguousarray(faces, dtype=np.int32),
        np.ascontiguousarray(np.arange(len(faces)) if labels is None else labels, dtype=np.int32),
        np.ascontiguousarray(world_to_camera, dtype=np.float64),
        fx, fy, cx, cy, perspective, height, width, image, nearness,
    )  # fmt: skip
    with np.errstate(divide="ignore"):
        depth = 1 / nearness if perspective else -nearness
    depth[image < 0] = np.inf
    return image[:pixels].reshape(image_size), depth[:pixels].reshape(image_size)


# With numpy's error model, division by zero does not raise; the test of the area rejects the NaN.
@njit(cache=True, nogil=True, error_model="numpy")
def _draw(
    vertices, faces, labels, world_to_camera, fx, fy, cx, cy, perspective,
    height, width, image, nearness,
):  # fmt: skip
    m = world_to_camera
    camera = np.empty((len(vertices), 3))
    screen = np.empty((len(vertices), 3))  # u, v, nearness
    for i in range(len(vertices)):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        for row in range(3):
            camera[i, row] = m[row, 0] * x + m[row, 1] * y + m[row, 2] * z + m[row, 3]
        screen[i, 0], screen[i, 1], screen[i, 2] = _project(
            camera[i, 0], camera[i, 1], camera[i, 2], fx, fy, cx, cy, perspective
        )

    clipped = np.empty((4, 3))
    corners = np.empty((4, 3))
    for face in range(len(faces)):
        # Unsigned, since Numba tests at every signed index whether it is negative.
        a, b, c = np.uint32(faces[face, 0]), np.uint32(faces[face, 1]), np.uint32(faces[face, 2])
        in_front = (
            int(camera[a, 2] >= NEAR_PLANE_M)
            + int(camera[b, 2] >= NEAR_PLANE_M)
            + int(camera[c, 2] >= NEAR_PLANE_M)
        )
        if in_front == 3:
            _fill(screen, a, b, c, labels[face], height, width, image, nearness)
        elif in_front > 0:
            count = _clip(camera[a], camera[b], camera[c], clipped)
            for i in range(count):
                corners[i, 0], corners[i, 1], corners[i, 2] = _project(
                    clipped[i, 0], clipped[i, 1], clipped[i, 2], fx, fy, cx, cy, perspective
                )
            for i in range(2, count):
                _fill(corners, 0, i - 1, i, labels[face], height, width, image, nearness)


@njit(cache=True, nogil=True, error_model="numpy")
def _project(x, y, z, fx, fy, cx, cy, perspective):
    """u, v and nearness of a point in front of the camera."""
    if perspective:
        inverse = 1.0 / z
        return fx * x * inverse + cx, fy * y * inverse + cy, inverse
    return fx * x + cx, fy * y + cy, -z


@njit(cache=True, nogil=True, error_model="numpy")
def _clip(a, b, c, out):
    """Clip a triangle to the part beyond the near plane; returns its three or four corners."""
    count = 0
    triangle = (a, b, c)
    for i in range(3):
        here, there = triangle[i], triangle[(i + 1) % 3]
        if here[2] >= NEAR_PLANE_M:
            for axis in range(3):
                out[count, axis] = here[axis]
            count += 1
        if (here[2] >= NEAR_PLANE_M) != (there[2] >= NEAR_PLANE_M):
            share = (NEAR_PLANE_M - here[2]) / (there[2] - here[2])
            for axis in range(2):
                out[count, axis] = here[axis] + share * (there[axis] - here[axis])
            out[count, 2] = NEAR_PLANE_M
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _fill(points, a, b, c, label, height, width, image, nearness):
    """Draw the triangle of three rows (u, v, nearness) of `points`."""
    # Scalars instead of rows, since creating array views for every triangle is slow.
    a_u, a_v, a_near = points[a, 0], points[a, 1], points[a, 2]
    b_u, b_v, b_near = points[b, 0], points[b, 1], points[b, 2]
    c_u, c_v, c_near = points[c, 0], points[c, 1], points[c, 2]
    left, right = min(a_u, b_u, c_u), max(a_u, b_u, c_u)
    top, bottom = min(a_v, b_v, c_v), max(a_v, b_v, c_v)
    # Clamped before the conversion to int, since a corner may lie billions of pixels away.
    first_column = math.ceil(max(left, 0.0) - 0.5)
    last_column = math.floor(min(right, float(width)) - 0.5)
    first_row = math.ceil(max(top, 0.0) - 0.5)
    last_row = math.floor(min(bottom, float(height)) - 0.5)
    if first_column > last_column or first_row > last_row:
        return  # between pixel centres, or outside the picture
    area = (b_u - a_u) * (c_v - a_v) - (b_v - a_v) * (c_u - a_u)
    if not abs(area) > 1e-12:  # seen edge on, or NaN
        return
    # Barycentric weights are linear in screen space; dividing by the signed area makes them
    # positive inside for either winding.
    dx_b, dy_b = (c_v - a_v) / area, -(c_u - a_u) / area
    dx_c, dy_c = -(b_v - a_v) / area, (b_u - a_u) / area
    triangle = (dx_b, dx_c, a_near, b_near - a_near, c_near - a_near)
    narrow = last_column - first_column < _NARROW_PX
    x_0, x_1 = first_column + 0.5 - a_u, first_column + 1.5 - a_u
    x_2, x_3 = first_column + 2.5 - a_u, first_column + 3.5 - a_u
    for row in range(first_row, last_row + 1):
        y = row + 0.5 - a_v
        row_b, row_c = dy_b * y, dy_c * y
        if narrow:
            # All four are read before one is written, so that the processor can overlap them.
            # Pixels right of the last column are read, and written back unchanged.
            p_0 = np.uint64(row * width + first_column)
            p_1, p_2, p_3 = p_0 + np.uint64(1), p_0 + np.uint64(2), p_0 + np.uint64(3)
            near_0 = _near_at(x_0, row_b, row_c, triangle, True)
            near_1 = _near_at(x_1, row_b, row_c, triangle, first_column + 1 <= last_column)
            near_2 = _near_at(x_2, row_b, row_c, triangle, first_column + 2 <= last_column)
            near_3 = _near_at(x_3, row_b, row_c, triangle, first_column + 3 <= last_column)
            old_0, old_1, old_2, old_3 = nearness[p_0], nearness[p_1], nearness[p_2], nearness[p_3]
            label_0, label_1, label_2, label_3 = image[p_0], image[p_1], image[p_2], image[p_3]
            nearness[p_0], image[p_0] = _nearer(near_0, label, old_0, label_0)
            nearness[p_1], image[p_1] = _nearer(near_1, label, old_1, label_1)
            nearness[p_2], image[p_2] = _nearer(near_2, label, old_2, label_2)
            nearness[p_3], image[p_3] = _nearer(near_3, label, old_3, label_3)
        else:
            for column in range(first_column, last_column + 1):
                near = _near_at(column + 0.5 - a_u, row_b, row_c, triangle, True)
                pixel = np.uint64(row * width + column)
                if near > nearness[pixel]:
                    nearness[pixel] = near
                    image[pixel] = label


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _near_at(x, row_b, row_c, triangle, wanted):
    """Inverse depth of a triangle at a pixel centre; -inf outside it or if `wanted` is false."""
    dx_b, dx_c, a_near, slope_b, slope_c = triangle
    weight_b = dx_b * x + row_b
    weight_c = dx_c * x + row_c
    # & instead of `and`, to branch once instead of three times.
    inside = (weight_b >= -_SLACK) & (weight_c >= -_SLACK) & (weight_b + weight_c <= 1.0 + _SLACK)
    near = np.float32(a_near + weight_b * slope_b + weight_c * slope_c)
    return near if inside & wanted else np.float32(-np.inf)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _nearer(near, label, old_near, old_label):
    """The nearer of two (nearness, label) pairs; the old one if they are equally near."""
    return (near, label) if near > old_near else (old_near, old_label)

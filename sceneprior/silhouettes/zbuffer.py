"""The hard rasteriser: triangles and one camera in, each pixel's nearest face and depth out."""

import math
from typing import no_type_check

import numpy as np
from numba import njit

NEAR_M = 0.01
"""Triangles are cut where they come nearer to the camera than this."""

# Rounding must not open a crack where a pixel centre lies on the edge of two faces. It widens a
# face by a billionth of its own size.
_SLACK = 1e-9


def rasterize(
    vertices: np.ndarray,
    faces: np.ndarray,
    world_to_camera: np.ndarray,
    projection: tuple[float, float, float, float],
    image_size: tuple[int, int],
    perspective: bool = True,
    near_m: float = NEAR_M,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw triangles into a z-buffer, sampled at pixel centres.

    Both sides of a triangle are drawn. A pixel centre on an edge belongs to the triangle; where
    two faces are equally near, the lower face index wins, so the picture never depends on luck.

    Args:
        vertices: (V, 3) world positions in metres.
        faces: (F, 3) corners of each triangle, as indices into `vertices`.
        world_to_camera: (4, 4), OpenCV axes (x right, y down, z forward).
        projection: fx, fy, cx, cy with u = fx * x / z + cx (perspective) or u = fx * x + cx
            (orthographic, fx in pixels per metre); v likewise from y.
        image_size: (height, width) in pixels.
        perspective: False for an orthographic camera.
        near_m: What is nearer than this plane is cut away.

    Returns:
        face_index: (height, width) int32, -1 where nothing is drawn.
        depth: (height, width) float32, z in metres along the optical axis; inf where nothing is.

    Example: a wall 2 m away, left of the axis, fills the left half of the picture.

        >>> wall = np.array([[-9.0, -9, 2], [0, -9, 2], [0, 9, 2], [-9, 9, 2]])
        >>> faces = np.array([[0, 1, 2], [0, 2, 3]])
        >>> index, depth = rasterize(wall, faces, np.eye(4), (4.0, 4.0, 2.0, 2.0), (4, 4))
        >>> depth[0].tolist()
        [2.0, 2.0, inf, inf]
    """
    height, width = image_size
    # 1/z (or -z) of what is nearest so far: both are straight lines across a triangle on screen.
    nearness = np.full((height, width), -np.inf, dtype=np.float32)
    face_index = np.full((height, width), -1, dtype=np.int32)
    fx, fy, cx, cy = (float(value) for value in projection)
    _draw(
        np.ascontiguousarray(vertices, dtype=np.float64),
        np.ascontiguousarray(faces, dtype=np.int32),
        np.ascontiguousarray(world_to_camera, dtype=np.float64),
        fx, fy, cx, cy, perspective, float(near_m), face_index, nearness,
    )  # fmt: skip
    with np.errstate(divide="ignore"):
        depth = 1 / nearness if perspective else -nearness
    depth[face_index < 0] = np.inf
    return face_index, depth


# no_type_check: the tests' type hook wraps every function, and Numba cannot compile a wrapper.
@njit(cache=True, nogil=True)
@no_type_check
def _draw(
    vertices, faces, world_to_camera, fx, fy, cx, cy, perspective, near_m, face_index, nearness
):  # fmt: skip
    m = world_to_camera
    camera = np.empty((len(vertices), 3))
    screen = np.empty((len(vertices), 3))  # u, v, nearness
    for i in range(len(vertices)):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        for row in range(3):
            camera[i, row] = m[row, 0] * x + m[row, 1] * y + m[row, 2] * z + m[row, 3]
        _project(camera[i], fx, fy, cx, cy, perspective, near_m, screen[i])

    clipped = np.empty((4, 3))
    corners = np.empty((4, 3))
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        in_front = (
            int(camera[a, 2] >= near_m) + int(camera[b, 2] >= near_m) + int(camera[c, 2] >= near_m)
        )
        if in_front == 3:
            _fill(screen[a], screen[b], screen[c], face, face_index, nearness)
        elif in_front > 0:
            count = _clip(camera[a], camera[b], camera[c], near_m, clipped)
            for i in range(count):
                _project(clipped[i], fx, fy, cx, cy, perspective, near_m, corners[i])
            for i in range(2, count):
                _fill(corners[0], corners[i - 1], corners[i], face, face_index, nearness)


@njit(cache=True, nogil=True)
@no_type_check
def _project(point, fx, fy, cx, cy, perspective, near_m, out):
    if not perspective:
        out[0], out[1], out[2] = fx * point[0] + cx, fy * point[1] + cy, -point[2]
    elif point[2] >= near_m:
        inverse = 1.0 / point[2]
        out[0], out[1], out[2] = fx * point[0] * inverse + cx, fy * point[1] * inverse + cy, inverse


@njit(cache=True, nogil=True)
@no_type_check
def _clip(a, b, c, near_m, out):
    """Keep the part of a triangle beyond the near plane: three or four corners."""
    count = 0
    triangle = (a, b, c)
    for i in range(3):
        here, there = triangle[i], triangle[(i + 1) % 3]
        if here[2] >= near_m:
            for axis in range(3):
                out[count, axis] = here[axis]
            count += 1
        if (here[2] >= near_m) != (there[2] >= near_m):
            share = (near_m - here[2]) / (there[2] - here[2])
            for axis in range(2):
                out[count, axis] = here[axis] + share * (there[axis] - here[axis])
            out[count, 2] = near_m
            count += 1
    return count


@njit(cache=True, nogil=True)
@no_type_check
def _fill(a, b, c, face, face_index, nearness):
    height, width = nearness.shape
    left, right = min(a[0], b[0], c[0]), max(a[0], b[0], c[0])
    top, bottom = min(a[1], b[1], c[1]), max(a[1], b[1], c[1])
    # Clamp before the conversion to int: a far corner may lie billions of pixels away.
    first_column = math.ceil(max(left, 0.0) - 0.5)
    last_column = math.floor(min(right, float(width)) - 0.5)
    first_row = math.ceil(max(top, 0.0) - 0.5)
    last_row = math.floor(min(bottom, float(height)) - 0.5)
    if first_column > last_column or first_row > last_row:
        return  # between pixel centres, or outside the picture
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if not abs(area) > 1e-12:  # seen edge on, or not a number
        return
    # Barycentric weights are planes over the screen; dividing by the signed area makes them
    # positive inside whichever way round the corners are named.
    dx_b, dy_b = (c[1] - a[1]) / area, -(c[0] - a[0]) / area
    dx_c, dy_c = -(b[1] - a[1]) / area, (b[0] - a[0]) / area
    slope_b, slope_c = b[2] - a[2], c[2] - a[2]
    for row in range(first_row, last_row + 1):
        y = row + 0.5 - a[1]
        inside = False
        for column in range(first_column, last_column + 1):
            x = column + 0.5 - a[0]
            weight_b = dx_b * x + dy_b * y
            weight_c = dx_c * x + dy_c * y
            if weight_b >= -_SLACK and weight_c >= -_SLACK and weight_b + weight_c <= 1.0 + _SLACK:
                inside = True
                near = np.float32(a[2] + weight_b * slope_b + weight_c * slope_c)
                if near > nearness[row, column]:
                    nearness[row, column] = near
                    face_index[row, column] = face
            elif inside:
                break  # a triangle has no second span in a row

"""Converts projections of tilt-shift cameras to projections of pinhole cameras."""

import numpy as np
from scipy.linalg import rq

from data_prep.readers.frames import GL_TO_CV


def pinhole(cam_from_uv: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Split a projection of Hypersim into intrinsics, with skew, and a rotation of the camera.

    `cam_from_uv` (3, 3) maps (u, v, 1), both in [-1, 1] with v upwards, to a ray in OpenGL's camera
    axes. A camera with a tilted image plane equals a rotated pinhole camera, since any invertible
    matrix is an upper triangular matrix times a rotation.

    Returns:
        Intrinsics, (3, 3), pixel centres at i + 0.5; and the rotation, (3, 3), from OpenCV's axes
        of the scene's camera to those of the pinhole.

    Example: no tilt, 90 degrees wide.

        >>> intrinsics, tilt = pinhole(np.diag([1.0, 0.75, -1.0]), (768, 1024))
        >>> intrinsics.round(6).tolist()
        [[512.0, 0.0, 512.0], [0.0, 512.0, 384.0], [0.0, 0.0, 1.0]]
    """
    height, width = size
    uv_from_pixel = np.array([[2 / width, 0, -1], [0, -2 / height, 1], [0, 0, 1.0]])
    pixel_from_ray = np.linalg.inv(GL_TO_CV[:3, :3] @ cam_from_uv @ uv_from_pixel)
    intrinsics, turn = rq(pixel_from_ray)
    signs = np.diag(np.sign(np.diag(intrinsics)))
    intrinsics, turn = intrinsics @ signs, signs @ turn
    return intrinsics / intrinsics[2, 2], turn


def straight_grid(
    lines: tuple[np.ndarray, ...], intrinsics: np.ndarray, size: tuple[int, int]
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Remove the skew of `intrinsics` by shifting the rows of an image.

    An image plane that is tilted about both axes has a skewed pixel grid, which shards cannot
    store: u = fx * x / z + skew * y / z + cx. Within its row, each pixel takes the value of the
    pixel to which the skew moves it.

    Args:
        lines: Rows (h, 1) and columns (1, w) of an image of `size`, (height, width).

    Returns:
        Rows and columns to read, (h, w); and True for the pixels within the image, (h, w).
    """
    rows, columns = lines
    shift = intrinsics[0, 1] * (rows + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1]
    columns = np.floor(columns + 0.5 + shift).astype(np.int64)
    inside = (columns >= 0) & (columns < size[1])
    return (np.broadcast_to(rows, columns.shape), columns.clip(0, size[1] - 1)), inside

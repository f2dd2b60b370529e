"""Soft shadows: the share of light from the sky that reaches each pixel of a picture."""

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from sceneprior.core.cameras import Pinhole

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
    from sceneprior.render.offscreen.zbuffer import rasterize

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
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, [0, 0, 2 * reach_m] - rotation @ middle_m
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

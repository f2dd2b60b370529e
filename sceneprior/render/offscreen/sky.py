"""Light from the sky: how much of it reaches each pixel of a picture, for soft shadows."""

import numpy as np
from jaxtyping import Float, Int

from sceneprior.render.offscreen.cameras import Pinhole

DIRECTIONS = 24
"""Directions towards the sky in which light is blocked or not."""
MAP_PX = 320
"""Side of the depth map of each direction."""
BIAS_M = 0.02
"""Depth by which something must be nearer to the sky to cast a shadow."""
DARKEST = 0.45
"""Brightness where no light from the sky arrives."""


def sky_light(
    vertices_m: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    camera: Pinhole,
    depth_m: Float[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Brightness in [`DARKEST`, 1] of each pixel: the share of the directions towards the sky, more
    of them upwards, in which nothing stands between. 1 where the picture shows nothing.

    `depth_m` is that at the middle of each pixel's upper left quarter.
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
    open_sky = np.zeros(len(points_m))
    for towards in _directions():
        side = np.cross([0.0, 0.0, 1.0], towards)
        side /= np.linalg.norm(side)
        rotation = np.stack([side, np.cross(-towards, side), -towards])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, [0, 0, 2 * reach_m] - rotation @ middle_m
        projection = (scale, scale, MAP_PX / 2, MAP_PX / 2)
        _, nearest = rasterize(vertices_m, faces, pose, projection, (MAP_PX, MAP_PX), False)
        seen = points_m @ rotation.T + pose[:3, 3]
        u, v = np.clip(seen[:, :2] * scale + MAP_PX / 2, 0, MAP_PX - 1).astype(int).T
        # A pixel of the map is as wide as its slope may be high.
        open_sky += seen[:, 2] <= nearest[v, u] + BIAS_M + 1 / scale
    light[rows, columns] = DARKEST + (1 - DARKEST) * open_sky / DIRECTIONS
    return light


def _directions() -> Float[np.ndarray, "directions 3"]:
    """Unit vectors of the upper half of a sphere, as many per solid angle as the cosine of their
    angle with the vertical; on a spiral, always the same."""
    order = (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    flat, turn = np.sqrt(order), np.arange(DIRECTIONS) * np.pi * (3 - np.sqrt(5))
    return np.stack([flat * np.cos(turn), np.sqrt(1 - order), flat * np.sin(turn)], axis=1)

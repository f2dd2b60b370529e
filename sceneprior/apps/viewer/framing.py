"""Cameras that show the whole room, for browser windows of any aspect ratio."""

import numpy as np
from jaxtyping import Float

from sceneprior.core.scene import Scene
from sceneprior.core.shell import Shell
from sceneprior.render.appearance import scene_meshes

FOV_RAD = 0.75
"""Vertical field of view of the camera."""
ASPECT = 1.3
"""Width-to-height ratio of the window, until a browser reports its own."""
CORNER = np.array([-0.42, -0.62, -0.66])
"""Viewing direction if only a room is shown, as in the pictures of rooms."""
FRONT = np.array([0.0, -0.6, -0.8])
"""Viewing direction if a room is shown beside the map, which faces the camera."""
MARGIN = 0.92
"""Share of the window that the points may fill."""


def framed(
    points_m: Float[np.ndarray, "points 3"],
    forward: Float[np.ndarray, "3"],
    fov_rad: float,
    aspect: float,
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Position and target of the nearest camera that sees all points, with y up.

    Args:
        forward: Viewing direction, not straight up or down.
        fov_rad: Vertical field of view.
        aspect: Width-to-height ratio of the window.
    """
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    upward = np.cross(right, forward)
    depth = points_m @ forward
    slope = MARGIN * np.tan(fov_rad / 2)
    # A camera at depth -away sees a point if |across - middle| <= slope * (depth + away).
    middle, away = [], []
    for across, own in ((points_m @ right, slope * aspect), (points_m @ upward, slope)):
        high, low = (across - own * depth).max(), (-across - own * depth).max()
        middle.append((high - low) / 2)
        away.append((high + low) / 2 / own)
    eye = middle[0] * right + middle[1] * upward - max(away) * forward
    return eye, eye + (depth.mean() + max(away)) * forward


def viewing_direction(wxyz: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3"]:
    """The viewing direction (the camera's +z) of a camera orientation in viser."""
    w, x, y, z = wxyz
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def room_bounds(scene: Scene, shell: Shell, walls: bool) -> Float[np.ndarray, "2 3"]:
    """The lowest and highest corner of a room's floor, furniture and, if shown, walls."""
    floor = np.insert(shell.outline_m, 1, 0.0, axis=1)
    points = [floor, *(mesh.vertices_m for mesh in scene_meshes(scene))]
    if walls:
        points.append(np.insert(shell.outline_m, 1, shell.height_m, axis=1))
    every = np.concatenate(points)
    return np.stack([every.min(axis=0), every.max(axis=0)])


def box_points(bounds_m: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "8 3"]:
    """The eight corners of a box, from its lowest and highest corner."""
    return np.stack(np.meshgrid(*bounds_m.T), axis=-1).reshape(8, 3)

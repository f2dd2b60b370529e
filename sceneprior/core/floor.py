"""The floor of a scene as a polygon."""

import numpy as np
import shapely

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene

MARGIN_M = 0.2
"""Distance between furniture and the edge of the assumed floor of scenes without one."""


def floor_polygon(scene: Scene) -> shapely.Geometry | None:
    """The floor of a scene as a polygon; None if the scene has no outline."""
    if scene.floor_m is None:
        return None
    outline = np.asarray(scene.floor_m, dtype=np.float64)
    if outline.ndim == 2 and len(outline) >= 3 and outline.shape[1] == 2:
        floor = shapely.make_valid(shapely.Polygon(outline))
        if floor.area > 0:
            return floor
    raise InputError(
        f"The floor of scene '{scene.name}' has no area; `floor_m` lists at least 3 corners "
        "[x, z] in metres, or is left out."
    )


def floor_rectangle(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (x, z) of the rectangle around the floor; without a known floor, of
    the rectangle around the objects with a margin of 20 cm."""
    if scene.floor_m is not None and len(scene.floor_m):
        outline = np.asarray(scene.floor_m, dtype=np.float64)
        return outline.min(0), outline.max(0)
    if not scene.objects:
        return np.array([-1.5, -1.5]), np.array([1.5, 1.5])
    flat, half = scene.centers_m[:, [0, 2]], scene.sizes_m[:, [0, 2]] / 2
    return (flat - half).min(0) - MARGIN_M, (flat + half).max(0) + MARGIN_M

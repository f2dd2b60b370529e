"""The floor of a scene as a polygon."""

import numpy as np
import shapely

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene


def floor_polygon(scene: Scene) -> shapely.Geometry | None:
    """Polygon of a scene's floor; None if the scene has no outline."""
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

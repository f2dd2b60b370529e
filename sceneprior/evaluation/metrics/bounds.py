"""SceneEval's OOB: objects whose surface extends beyond the floor."""

import numpy as np
import shapely
from jaxtyping import Bool

from sceneprior.core.outline import floor_polygon
from sceneprior.core.scene import Scene
from sceneprior.core.surfaces import surface_points
from sceneprior.evaluation.metric import USED, Counts, Metric
from sceneprior.evaluation.surfaces import FLUSH_M, own_box, triangles_of

INSIDE_SHARE = 0.99
"""Minimum share of an object's surface points above the floor for the object to be in bounds."""
POINTS_PER_M3, FEWEST_POINTS = 5000, 1000
"""Surface points per cubic metre of the object's box, and their minimum number."""


def out_of_bounds(scene: Scene) -> Bool[np.ndarray, " objects"] | None:
    """True for objects with less than 99% of their surface over the floor: SceneEval's OOB.

    The surface is represented by `max(1000, 5000 * volume of the box in m3)` points, drawn
    uniformly by area. A point is in bounds if the floor is below it. None if there is no floor.

    Source:
        3dlg-hcvc/SceneEval, metrics/out_of_bound.py. There the box is the smallest oriented one,
        and the floor lies at the lowest point of all objects, so that no point is below it; here
        the box is the object's own (axis-aligned if its yaw is unknown), heights are ignored, and
        the floor is 1 mm wider on all sides (`FLUSH_M`).
    """
    floor = floor_polygon(scene)
    if floor is None:
        return None
    floor = floor.buffer(FLUSH_M, join_style="mitre")
    shapely.prepare(floor)
    found = []
    for row, item in enumerate(scene.objects):
        triangles = triangles_of(item)
        count = max(int(np.prod(own_box(item).size_m) * POINTS_PER_M3), FEWEST_POINTS)
        corners = triangles.reshape(-1, 3)
        points = surface_points(corners, np.arange(len(corners)).reshape(-1, 3), count, seed=row)
        within = shapely.contains_xy(floor, points[:, 0], points[:, 2])
        found.append(within.mean() < INSIDE_SHARE)
    return np.array(found, dtype=bool)


def _oob(scene: Scene) -> Counts:
    found = out_of_bounds(scene)
    pair = (0.0, 0.0) if found is None else (float(found.sum()), len(found))
    return {"sceneeval_oob_objects": pair}


METRICS = (
    Metric(
        "sceneeval_oob_objects", "OOB: objects out of bounds (SceneEval)",
        "share; known floors only", "lower", _oob, USED,
    ),
)  # fmt: skip

"""Metrics of the floor: objects outside its outline, and the walkable area between objects.

Areas of footprints (axis-aligned boxes on the floor, x and z) are exact (shapely), except that
rounded corners are polygons of `ARC_SEGMENTS` sides per quarter turn."""

from functools import partial

import numpy as np
import shapely

from sceneprior.core.classes import VOID
from sceneprior.core.scene import Scene
from sceneprior.core.shell import floor_polygon
from sceneprior.core.surfaces import surface_points
from sceneprior.evaluation.metric import (
    USED,
    Comparison,
    Counts,
    Estimate,
    RoomSet,
    mean_over_rooms,
    metric,
    ratio,
)
from sceneprior.evaluation.surfaces import FLUSH_M, own_box, triangles_of

AGENT_RADIUS_M = 0.2
AGENT_HEIGHT_M = 1.5
"""Height of the cylindrical agent; objects that hang higher, such as lamps, do not block it."""
OUTSIDE_SHARE = 0.05
"""Share of an object's footprint outside the floor above which it is out of bounds."""
ARC_SEGMENTS = 8
INSIDE_SHARE = 0.99
"""Minimum share of an object's surface points above the floor for the object to be in bounds."""
POINTS_PER_M3, FEWEST_POINTS = 5000, 1000
"""Surface points per cubic metre of the object's box, and their minimum number."""


def footprints(scene: Scene, below_m: float = np.inf) -> np.ndarray:
    """Footprints, as polygons, of non-void objects whose lower face is lower than `below_m`."""
    low, high = scene.centers_m - scene.sizes_m / 2, scene.centers_m + scene.sizes_m / 2
    kept = (scene.class_indices != VOID) & (low[:, 1] < below_m)
    return np.asarray(shapely.box(*low[kept][:, [0, 2]].T, *high[kept][:, [0, 2]].T))


def outside_count(scene: Scene) -> tuple[int, int]:
    """(objects out of bounds, all objects); (0, 0) for a scene without a floor outline.

    An object is out of bounds if more than 5% of its footprint lies outside the outline.

    Example: a floor of 4 x 4 m, and a desk with half its width outside.

        >>> from sceneprior.core.scene import SceneObject
        >>> desk = SceneObject("desk", (2.0, 0.4, 0.0), (1.0, 0.8, 0.5))
        >>> floor = np.array([[-2, -2], [2, -2], [2, 2], [-2, 2]])
        >>> outside_count(Scene("a", "front3d_bedroom", (desk,), floor))
        (1, 1)
    """
    floor = floor_polygon(scene)
    if floor is None:
        return 0, 0
    boxes = footprints(scene)
    beyond = shapely.area(shapely.difference(boxes, floor))
    return int((beyond > OUTSIDE_SHARE * shapely.area(boxes)).sum()), len(boxes)


def walkable_share(scene: Scene, within: str = "furniture") -> float | None:
    """Area of the largest connected free region, as a share of the whole free area.

    A position is free if the agent, a cylinder of radius 0.2 m and height 1.5 m, intersects neither
    a wall nor an object there. 1 means that the free area is connected, 0 that the agent fits
    nowhere. The metric is that of Yang et al., CVPR 2024, with exact areas instead of pixels.

    Args:
        within: The walls. `furniture`: the rectangle around all furniture, which every scene has,
            so that rooms with and without a floor can be compared. `floor`: the floor's outline.

    Returns:
        A share in [0, 1]; None for a room without an outline (`floor`), or with fewer than two
        objects, whose rectangle has no space between them (`furniture`).
    """
    if within == "floor":
        walls = floor_polygon(scene)
    else:
        boxes = footprints(scene)
        walls = shapely.envelope(shapely.union_all(boxes)) if len(boxes) > 1 else None
    if walls is None:
        return None
    stand = shapely.buffer(walls, -AGENT_RADIUS_M, quad_segs=ARC_SEGMENTS)
    blocked = shapely.union_all(
        shapely.buffer(footprints(scene, AGENT_HEIGHT_M), AGENT_RADIUS_M, quad_segs=ARC_SEGMENTS)
    )
    pieces = shapely.area(shapely.get_parts(shapely.difference(stand, blocked)))
    return float(pieces.max() / pieces.sum()) if pieces.sum() > 0 else 0.0


@metric(
    "out_of_bounds_share", "Pieces out of the floor's bounds", "share; known floors only", "lower",
    protocol={
        "out_of_bounds_share": f"pieces with more than {OUTSIDE_SHARE:.0%} of their box outside "
        "floor_m; rooms without floor_m are left out"
    },
)  # fmt: skip
def _out_of_bounds(rooms: RoomSet, comparison: Comparison) -> Estimate:
    outside, pieces = np.array([outside_count(scene) for scene in rooms.scenes], dtype=float).T
    return ratio(outside, pieces, rooms.counts, 1.0)


metric(
    "walkable_share", "Walkable in one piece, between furniture", "share of free floor", "higher",
    protocol={
        "walkable_share": f"disc of {AGENT_RADIUS_M} m, {AGENT_HEIGHT_M} m high; exact areas; "
        "_floor: within floor_m, else the rectangle around all furniture"
    },
)(mean_over_rooms(walkable_share, 1.0))  # fmt: skip
metric(
    "walkable_share_floor", "Walkable in one piece, within the floor", "share; known floors only",
    "higher",
)(mean_over_rooms(partial(walkable_share, within="floor"), 1.0))  # fmt: skip


@metric(
    "sceneeval_oob_objects", "OOB: objects out of bounds (SceneEval)", "share; known floors only",
    "lower", USED,
)  # fmt: skip
def out_of_bounds(scene: Scene) -> Counts:
    """Objects with less than 99% of their surface over the floor: SceneEval's OOB.

    The surface is represented by `max(1000, 5000 * volume of the box in m3)` points, drawn
    uniformly by area. A point is in bounds if the floor is below it. Unknown
    without a floor.

    Source:
        3dlg-hcvc/SceneEval, metrics/out_of_bound.py. There the box is the smallest oriented one,
        and the floor lies at the lowest point of all objects, so that no point is below it; here
        the box is the object's own (axis-aligned if its yaw is unknown), heights are ignored, and
        the floor is 1 mm wider on all sides (`FLUSH_M`).
    """
    floor = floor_polygon(scene)
    if floor is None:
        return {}
    floor = floor.buffer(FLUSH_M, join_style="mitre")
    shapely.prepare(floor)
    outside = 0
    for row, item in enumerate(scene.objects):
        triangles = triangles_of(item)
        count = max(int(np.prod(own_box(item).size_m) * POINTS_PER_M3), FEWEST_POINTS)
        corners = triangles.reshape(-1, 3)
        points = surface_points(corners, np.arange(len(corners)).reshape(-1, 3), count, seed=row)
        within = shapely.contains_xy(floor, points[:, 0], points[:, 2])
        outside += bool(within.mean() < INSIDE_SHARE)
    return {"sceneeval_oob_objects": (float(outside), len(scene.objects))}

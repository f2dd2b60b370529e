"""Metrics of the floor: objects outside its outline, and the walkable area between objects.

An object's footprint is its axis-aligned box on the floor (x, z). Areas are exact (shapely), except
that rounded corners are polygons of `ARC_SEGMENTS` sides per quarter turn.
"""

from functools import partial

import numpy as np
import shapely

from sceneprior.core.classes import VOID
from sceneprior.core.outline import floor_polygon
from sceneprior.core.scene import Scene
from sceneprior.evaluation.bootstrap import Estimate, ratio
from sceneprior.evaluation.metric import Comparison, Metric, RoomSet, mean_over_rooms

AGENT_RADIUS_M = 0.2
AGENT_HEIGHT_M = 1.5
"""Height of the cylindrical agent; objects that hang higher, such as lamps, do not block it."""
OUTSIDE_SHARE = 0.05
"""Share of an object's footprint outside the floor above which it is out of bounds."""
ARC_SEGMENTS = 8


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


def _out_of_bounds(rooms: RoomSet, comparison: Comparison) -> Estimate:
    outside, pieces = np.array([outside_count(scene) for scene in rooms.scenes], dtype=float).T
    return ratio(outside, pieces, rooms.counts, 1.0)


METRICS = (
    Metric(
        "out_of_bounds_share", "Pieces out of the floor's bounds", "share; known floors only",
        "lower",
        _out_of_bounds,
        protocol={
            "out_of_bounds_share": f"pieces with more than {OUTSIDE_SHARE:.0%} of their box "
            "outside floor_m; rooms without floor_m are left out"
        },
    ),
    Metric(
        "walkable_share", "Walkable in one piece, between furniture", "share of free floor",
        "higher",
        mean_over_rooms(walkable_share, 1.0),
        protocol={
            "walkable_share": f"disc of {AGENT_RADIUS_M} m, {AGENT_HEIGHT_M} m high; exact areas; "
            "_floor: within floor_m, else the rectangle around all furniture"
        },
    ),
    Metric(
        "walkable_share_floor", "Walkable in one piece, within the floor",
        "share; known floors only", "higher",
        mean_over_rooms(partial(walkable_share, within="floor"), 1.0),
    ),
)  # fmt: skip

"""The floor between furniture: pieces that stand outside it, and what can be walked.

Furniture is its axis-aligned box on the floor (x, z). All areas are exact (shapely), but for round
corners, which are polygons of `ARC_SEGMENTS` sides a quarter turn.
"""

from functools import partial

import numpy as np
import shapely

from sceneprior.classes import VOID
from sceneprior.errors import InputError
from sceneprior.evaluation.bootstrap import Estimate, ratio
from sceneprior.evaluation.metric import Comparison, Metric, RoomSet, mean_over_rooms
from sceneprior.scene import Scene

AGENT_RADIUS_M = 0.2
AGENT_HEIGHT_M = 1.5
"""Who walks: a cylinder. What hangs higher, such as a lamp, is not in the way."""
OUTSIDE_SHARE = 0.05
"""A piece is out of bounds with more than this part of its box beyond the floor's outline."""
ARC_SEGMENTS = 8


def footprints(scene: Scene, below_m: float = np.inf) -> np.ndarray:
    """The boxes of named furniture whose lower face is lower than `below_m`, as polygons."""
    low, high = scene.centers_m - scene.sizes_m / 2, scene.centers_m + scene.sizes_m / 2
    kept = (scene.class_indices != VOID) & (low[:, 1] < below_m)
    return np.asarray(shapely.box(*low[kept][:, [0, 2]].T, *high[kept][:, [0, 2]].T))


def floor_polygon(scene: Scene) -> shapely.Geometry | None:
    """The floor inside the scene's outline, None where it has none; no area is an InputError."""
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


def outside_count(scene: Scene) -> tuple[int, int]:
    """(pieces out of bounds, pieces with a floor to stand on); (0, 0) without a known floor.

    A piece is out of bounds with more than 5% of its box beyond the outline.

    Example: a floor of 4 x 4 m, and a desk that pokes out by half its width.

        >>> from sceneprior.scene import SceneObject
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
    """The largest area that can be walked in one piece, as a share of all that can be stood on.

    The agent, a disc of 0.2 m, stands where it meets neither a wall nor furniture lower than its
    1.5 m. 1 means that all free floor hangs together, 0 that the agent fits nowhere.

    Args:
        within: Where the walls are. `furniture`: the rectangle around all furniture, which every
            scene has, so that rooms with and without a floor compare. `floor`: the outline.

    Returns:
        In [0, 1]; None for a room without a floor (`floor`), or with fewer than two pieces, which
        leave no room in a rectangle around themselves (`furniture`).
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
        "out_of_bounds_share", "Pieces out of the floor's bounds", "share; known floors alone",
        "lower",
        "Share of pieces with more than 5% of their box, seen from above, outside the floor's "
        "outline; only rooms with `floor_m` count, null where none has one, as rooms of this "
        "package's prior, which knows no floor.",
        _out_of_bounds,
        protocol={
            "out_of_bounds_share": f"pieces with more than {OUTSIDE_SHARE:.0%} of their box "
            "outside floor_m; rooms without floor_m are left out"
        },
    ),
    Metric(
        "walkable_share", "Walkable in one piece, between furniture", "share of free floor",
        "higher",
        "The largest area that a disc of 0.2 m can walk in one piece, over all area it can stand "
        "on, mean over rooms; walls are the **rectangle around all furniture**, so that rooms "
        "with and without a floor compare; pieces whose lower face is at 1.5 m or higher are "
        "walked under; 0 where the disc fits nowhere, rooms with fewer than two pieces left out.",
        mean_over_rooms(walkable_share, 1.0), source="Yang et al., CVPR 2024, in exact areas",
        protocol={
            "walkable_share": f"disc of {AGENT_RADIUS_M} m, {AGENT_HEIGHT_M} m high; exact areas; "
            "_floor: within floor_m, else the rectangle around all furniture"
        },
    ),
    Metric(
        "walkable_share_floor", "Walkable in one piece, within the floor",
        "share; known floors alone", "higher",
        "`walkable_share` within `floor_m`; rooms without one are left out, null where none has "
        "one.",
        mean_over_rooms(partial(walkable_share, within="floor"), 1.0),
    ),
)  # fmt: skip

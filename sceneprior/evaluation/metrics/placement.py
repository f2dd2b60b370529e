"""Placement of objects: collisions between their meshes (SceneEval's COL, PhyScene's Col_obj and
Col_scene), objects outside the floor, and the walkable area between objects."""

from collections.abc import Callable
from itertools import combinations

import numpy as np
import shapely
from jaxtyping import Bool, Float

from sceneprior.core.scene import Scene
from sceneprior.core.shell import floor_polygon
from sceneprior.core.surfaces import surface_points
from sceneprior.evaluation.geometry import (
    FLUSH_M,
    Triangles,
    area_centroid,
    bounds,
    edge_hits,
    inside,
    meeting_pairs,
    point_count,
    triangles_of,
)
from sceneprior.evaluation.metric import (
    USED,
    Comparison,
    Counts,
    Estimate,
    RoomSet,
    TableColumn,
    mean_over_rooms,
    metric,
    ratio,
)

SEPARATION_M = 0.005
"""Distance by which two touching objects are moved apart before they are tested again."""
AGENT_RADIUS_M = 0.2
AGENT_HEIGHT_M = 1.5
"""Height of the cylindrical agent; objects that hang higher, such as lamps, do not block it."""
OUTSIDE_SHARE = 0.05
"""Share of an object's footprint outside the floor above which it is out of bounds."""
ARC_SEGMENTS = 8
"""Sides per quarter turn of the polygons that stand for rounded corners; other areas are exact."""
INSIDE_SHARE = 0.99
"""Minimum share of an object's surface points above the floor for the object to be in bounds."""
FEWEST_POINTS = 1000


def colliding(scene: Scene) -> Bool[np.ndarray, " objects"]:
    """True for objects whose surface intersects another object's: SceneEval's COL.

    Two objects collide if their triangles intersect or touch, and still do so after the second
    object is moved by 5 mm, from the mean of the contact points towards its own centroid. So
    objects that touch, or overlap by up to about 5 mm, do not collide; nor does an object that lies
    wholly inside another, because their surfaces do not intersect.

    Source:
        3dlg-hcvc/SceneEval, metrics/collision.py. SceneEval takes contact points from the library
        FCL; here they are the points where edges pass through triangles or, without such points,
        the centroids of the touching triangles.
    """

    def collide(a: Triangles, b: Triangles) -> bool:
        pairs = meeting_pairs(a, b)
        if not len(pairs):
            return False
        meeting = a[pairs[:, 0]], b[pairs[:, 1]]
        contacts = edge_hits(*meeting)
        if not len(contacts):
            contacts = np.concatenate(meeting).mean(axis=1)
        away = area_centroid(b) - contacts.mean(axis=0)
        b = b + away / (np.linalg.norm(away) or 1.0) * SEPARATION_M
        return _boxes_meet(bounds(a), bounds(b)) and len(meeting_pairs(a, b)) > 0

    return _in_pairs(scene, collide)


def containing(scene: Scene) -> Bool[np.ndarray, " objects"]:
    """True for both objects of a pair if the earlier one contains a vertex of the later one:
    PhyScene's collision test.

    Only vertices of the later object of a pair are tested, as in the published code, so two boxes
    that cross without a corner inside each other are missed.

    Source:
        PhyScene/PhyScene, scripts/eval/calc_ckl.py, `overlap_type: mesh` (Yang et al., CVPR 2024).
        PhyScene tests against closed, remeshed models; here a point is inside if its winding number
        in the original mesh, counted along +y, is not 0.
    """

    def contain(a: Triangles, b: Triangles) -> bool:
        points = np.unique(b.reshape(-1, 3), axis=0)
        low, high = bounds(a)
        points = points[((points > low) & (points < high)).all(axis=1)]
        return bool(inside(points, a).any())

    return _in_pairs(scene, contain)


def _in_pairs(
    scene: Scene, meet: Callable[[Triangles, Triangles], bool]
) -> Bool[np.ndarray, " objects"]:
    """True for both objects of every pair, the earlier one first, whose surfaces `meet`."""
    surfaces = [triangles_of(item) for item in scene.objects]
    boxes = [bounds(surface) for surface in surfaces]
    found = np.zeros(len(surfaces), dtype=bool)
    for first, second in combinations(range(len(surfaces)), 2):
        near = _boxes_meet(boxes[first], boxes[second])
        if near and not found[[first, second]].all() and meet(surfaces[first], surfaces[second]):
            found[[first, second]] = True
    return found


def _boxes_meet(a: Float[np.ndarray, "2 3"], b: Float[np.ndarray, "2 3"]) -> bool:
    """True if two boxes, given as in `bounds`, share a point."""
    return bool((np.minimum(a[1], b[1]) >= np.maximum(a[0], b[0])).all())


def _shares(name: str, found: Bool[np.ndarray, " objects"]) -> Counts:
    """Counts of the objects found, and of rooms with any."""
    return {
        f"{name}_objects": (float(found.sum()), len(found)),
        f"{name}_scenes": (float(found.any()), 1),
    }


@metric(
    "sceneeval_col_objects", "COL: objects that collide (SceneEval)", "share", "lower", USED,
    protocol={"surfaces": "meshes of the scenes; boxes of objects without a mesh"},
    column=TableColumn("colliding", 2, "colliding: objects that share volume with another"),
)  # fmt: skip
@metric("sceneeval_col_scenes", "COL: rooms with a collision (SceneEval)", "share", "lower", USED)
def _sceneeval(scene: Scene) -> Counts:
    return _shares("sceneeval_col", colliding(scene))


@metric("physcene_col_objects", "Col_obj: objects that collide (PhyScene)", "share", "lower", USED)
@metric(
    "physcene_col_scenes", "Col_scene: rooms with a collision (PhyScene)", "share", "lower", USED
)
def _physcene(scene: Scene) -> Counts:
    return _shares("physcene_col", containing(scene))


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
    boxes = _footprints(scene)
    beyond = shapely.area(shapely.difference(boxes, floor))
    return int((beyond > OUTSIDE_SHARE * shapely.area(boxes)).sum()), len(boxes)


@metric(
    "out_of_bounds_share", "Pieces out of the floor's bounds", "share; known floors only", "lower",
    protocol=f"pieces with more than {OUTSIDE_SHARE:.0%} of their box outside "
    "floor_m; rooms without floor_m are left out",
)  # fmt: skip
def _out_of_bounds(rooms: RoomSet, comparison: Comparison) -> Estimate:
    outside, pieces = np.array([outside_count(scene) for scene in rooms.scenes], dtype=float).T
    return ratio(outside, pieces, rooms.counts, 1.0)


def _footprints(scene: Scene, below_m: float = np.inf) -> np.ndarray:
    """Axis-aligned footprints, as polygons, of objects whose lower face is below `below_m`."""
    low, high = scene.centers_m - scene.sizes_m / 2, scene.centers_m + scene.sizes_m / 2
    kept = low[:, 1] < below_m
    return np.asarray(shapely.box(*low[kept][:, ::2].T, *high[kept][:, ::2].T))


def walkable_share(scene: Scene, walls: shapely.Geometry | None) -> float | None:
    """Area of the largest connected free region within walls, as a share of the whole free area.

    A position is free if the agent, a cylinder of radius 0.2 m and height 1.5 m, intersects neither
    a wall nor an object there. 1 means that the free area is connected, 0 that the agent fits
    nowhere; None without walls. The metric is that of Yang et al., CVPR 2024, with exact areas
    instead of pixels.
    """
    if walls is None:
        return None
    stand = shapely.buffer(walls, -AGENT_RADIUS_M, quad_segs=ARC_SEGMENTS)
    blocked = shapely.union_all(
        shapely.buffer(_footprints(scene, AGENT_HEIGHT_M), AGENT_RADIUS_M, quad_segs=ARC_SEGMENTS)
    )
    pieces = shapely.area(shapely.get_parts(shapely.difference(stand, blocked)))
    return float(pieces.max() / pieces.sum()) if pieces.sum() > 0 else 0.0


def between_furniture(scene: Scene) -> float | None:
    """Walkable share in the rectangle around all furniture, so that rooms with and without a floor
    can be compared; None with fewer than two objects, which have no space between them."""
    boxes = _footprints(scene)
    walls = shapely.envelope(shapely.union_all(boxes)) if len(boxes) > 1 else None
    return walkable_share(scene, walls)


metric(
    "walkable_share", "Walkable in one piece, between furniture", "share of free floor", "higher",
    protocol=f"disc of {AGENT_RADIUS_M} m, {AGENT_HEIGHT_M} m high; exact areas; "
    "_floor: within floor_m, else the rectangle around all furniture",
)(mean_over_rooms(between_furniture, 1.0))  # fmt: skip
metric(
    "walkable_share_floor", "Walkable in one piece, within the floor", "share; known floors only",
    "higher",
)(mean_over_rooms(lambda scene: walkable_share(scene, floor_polygon(scene)), 1.0))  # fmt: skip


@metric(
    "sceneeval_oob_objects", "OOB: objects out of bounds (SceneEval)", "share; known floors only",
    "lower", USED,
    column=TableColumn("out of bounds", 2, "out of bounds: objects that leave the floor"),
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
        corners = triangles_of(item).reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 3)
        points = surface_points(corners, faces, point_count(item, FEWEST_POINTS), seed=row)
        within = shapely.contains_xy(floor, points[:, 0], points[:, 2])
        outside += bool(within.mean() < INSIDE_SHARE)
    return {"sceneeval_oob_objects": (float(outside), len(scene.objects))}

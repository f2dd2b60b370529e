"""Contacts of rooms made right for physics: objects rest on something, and none overlap.

Generated rooms nearly meet these conditions, but furniture may float by a centimetre, and a lifted
chair may lack a leg or reach into a table. The changes are counted. Furniture whose centre of mass
lies outside its support polygon would fall over, and gets supports.
"""

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float

from sceneprior.core.colliders import (
    LEAST_M3,
    colliders,
    is_fixed,
    mesh_of,
    points_of,
    volume_and_centroid,
)
from sceneprior.core.scene import Mesh, Scene, SceneObject, Solid, Textured, join_meshes
from sceneprior.core.shell import floor_polygon

GAP_M = 2e-3
"""Distance between objects after they are pushed apart."""
SMALLEST = 0.98
"""Factor on the width and depth of crowded objects for which there would be no free place."""
TOUCHING_M = 5e-4
"""Largest overlap of two bodies that is tolerated."""
FLOOR_M = 0.3
"""Maximum height of the lower face of objects that are always set on the floor."""
RESTS_M = 0.15
"""Maximum vertical distance by which an object above `FLOOR_M` is moved onto another object. If no
object is within this distance, it is set on the floor, too."""
SLABS = 8
"""Number of slabs into which a body that is a mesh is cut."""
STEP_M, REACH_M = 0.05, 2.0
"""Spacing and range, along x and z, of the moves that are tried for an object."""

Boxes = Float[np.ndarray, "_ 2 3"]
"""Lower and upper corners of the boxes around the bodies of objects."""


class Stable(NamedTuple):
    """A scene whose objects stand and do not overlap, and what was changed for that."""

    scene: Scene
    changes: Counter[str]
    """Numbers of objects that were `set down`, `given feet`, `moved`, `shrunk` and `left out`."""
    left_out: list[str]
    """A sentence for each object that was left out: room, object, reason."""


def make_stable(scene: Scene) -> Stable:
    """Set down a scene's objects, give feet to those that would fall over, and move them apart.

    Objects are set down in the order of their heights, except lamps and objects that hang on walls.
    Then each object, the largest first, is moved to the nearest place where it overlaps no earlier
    object and lies no further outside the floor than before. If an object has no such place, it
    goes first and the larger ones are moved; then it and those that it overlaps are shrunk to
    `SMALLEST`; and only then it is left out.
    """
    changes: Counter[str] = Counter()
    # Convex parts of meshes take seconds, so they are computed once and kept as solids.
    with_bodies = tuple(replace(item, solids=colliders(item)) for item in scene.objects)
    objects = _set_down(with_bodies, changes)
    on_feet = [item if is_fixed(item) else add_supports(item) for item in objects]
    changes["given feet"] += sum(a is not b for a, b in zip(on_feet, objects, strict=True))
    kept = _apart(scene, on_feet, changes)
    left_out = [
        f"{scene.name}: {name} is left out: {_reason(on_feet, row)}."
        for row, name in enumerate(_names(on_feet))
        if row not in kept
    ]
    objects = [kept[row] for row in sorted(kept)]
    return Stable(replace(scene, objects=tuple(objects)), changes, left_out)


def _names(objects: Sequence[SceneObject]) -> list[str]:
    """Names of objects in messages, as those of their nodes in files."""
    return [f"{row}_{item.label}" for row, item in enumerate(objects)]


def _reason(objects: Sequence[SceneObject], row: int) -> str:
    """Say which objects stand in the place of the object `row`."""
    boxes, near = body_boxes(objects[row]), []
    for other, name in enumerate(_names(objects)):
        deep = 0.0
        for low, high in body_boxes(objects[other]) if other != row else ():
            shared = np.minimum(boxes[:, 1], high) - np.maximum(boxes[:, 0], low)
            deep = max(deep, float(shared.min(axis=1).max()))
        if deep > TOUCHING_M:
            near.append(f"{name} by {100 * deep:.1f} cm")
    there = f"it overlaps {' and '.join(near)}, and " if near else ""
    return f"{there}no place within {REACH_M:g} m is free"


def body_boxes(item: SceneObject) -> Boxes:
    """Boxes around the bodies of an object; meshes are cut into slabs along x, which follow a
    rotated body better than one box."""
    boxes: list[Any] = []
    for body in colliders(item):
        if not isinstance(body, Mesh):
            boxes.append([body.low_m, body.high_m])
            continue
        points = points_of(body)
        low, high = points.min(axis=0), points.max(axis=0)
        if not (high - low)[[0, 2]].all():  # flat, such as a pane
            boxes.append([low, high])
            continue
        plan = shapely.convex_hull(shapely.MultiPoint(points[:, ::2]))
        slabs = []
        for start, end in itertools.pairwise(np.linspace(low[0], high[0], SLABS + 1)):
            part = shapely.clip_by_rect(plan, start, low[2], end, high[2])
            if not part.is_empty:
                _, near, _, far = part.bounds
                slabs.append([[start, low[1], near], [end, high[1], far]])
        boxes += slabs or [[low, high]]
    return np.array(boxes, dtype=np.float64)


def _set_down(objects: tuple[SceneObject, ...], changes: Counter[str]) -> list[SceneObject]:
    """Set each object on the floor or on the object below it, the lowest first."""
    placed = list(objects)
    boxes = [body_boxes(item) for item in objects]
    low = np.array([each[:, 0].min(axis=0) for each in boxes]).reshape(-1, 3)
    high = np.array([each[:, 1].max(axis=0) for each in boxes]).reshape(-1, 3)
    bottoms, tops = low[:, 1].copy(), high[:, 1].copy()
    for row in np.argsort(bottoms, kind="stable"):
        item, bottom, height = objects[row], bottoms[row], 0.0
        if is_fixed(item):
            continue
        if bottom > FLOOR_M:
            overlaps = np.minimum(high[row], high) - np.maximum(low[row], low) > 0
            below = overlaps[:, [0, 2]].all(axis=1) & (np.abs(tops - bottom) <= RESTS_M)
            below[row] = False
            height = float(high[below, 1].max(initial=0.0))
        if abs(bottom - height) > 1e-6:
            placed[row] = item.moved((0.0, float(height - bottom), 0.0))
            high[row, 1] += height - bottom
            changes["set down"] += bool(abs(bottom - height) > 1e-3)
    return placed


def _apart(
    scene: Scene, objects: Sequence[SceneObject], changes: Counter[str]
) -> dict[int, SceneObject]:
    """Move objects apart, and return by their rows those that have a place (see `make_stable`)."""
    floor = floor_polygon(scene)
    if floor is not None:  # without the squares into which doors swing
        doors = [o for o in scene.openings if o.kind == "door"]
        lines = [shapely.LineString([door.start_m, door.end_m]) for door in doors]
        floor -= shapely.union_all([line.buffer(line.length, cap_style="flat") for line in lines])
    kept, sized, small = _in_places(objects, floor), objects, set[int]()
    lost = [row for row in range(len(objects)) if row not in kept]
    if lost:
        small = {row for one in lost for row in _overlapping(objects, one)}
        tight = [_shrunk(item) if row in small else item for row, item in enumerate(objects)]
        for given, first in ((objects, lost), (tight, ()), (tight, lost)):
            found = _in_places(given, floor, first)
            if len(found) > len(kept):
                kept, sized = found, given
    counts = {
        "moved": sum(item is not sized[row] for row, item in kept.items()),
        "shrunk": len(small & kept.keys()) if sized is not objects else 0,
        "left out": len(objects) - len(kept),
    }
    changes.update({change: count for change, count in counts.items() if count})
    return kept


def _in_places(
    objects: Sequence[SceneObject], floor: shapely.Geometry | None, first: Sequence[int] = ()
) -> dict[int, SceneObject]:
    """Move each object to its nearest free place, those of `first` before the others, and the
    larger ones before the smaller ones; objects without a free place are not returned."""
    taken, kept = np.zeros((0, 2, 3)), dict[int, SceneObject]()
    areas = [-item.size_m[0] * item.size_m[2] for item in objects]
    rows = np.argsort(areas, kind="stable").tolist()
    for row in sorted(rows, key=lambda row: row not in first):
        item, boxes = objects[row], body_boxes(objects[row])
        offset = free_offset(boxes, taken, floor)
        if offset is None:
            continue
        if offset.any():
            item = item.moved((float(offset[0]), 0.0, float(offset[1])))
            boxes = boxes + np.array([offset[0], 0.0, offset[1]])
        kept[row] = item
        taken = np.concatenate([taken, boxes])
    return kept


def _overlapping(objects: Sequence[SceneObject], row: int) -> list[int]:
    """Rows of the objects that overlap the object `row`, which is one of them."""
    boxes, still = body_boxes(objects[row]), np.zeros((1, 2))
    return [
        other
        for other, item in enumerate(objects)
        if _overlaps(boxes, body_boxes(item), still, -TOUCHING_M)[0]
    ]


def _shrunk(item: SceneObject) -> SceneObject:
    """The object, narrower and less deep by the factor `SMALLEST` around its centre."""
    factors = np.array([SMALLEST, 1.0, SMALLEST])
    smaller = item.in_box(item.center_m, (factors * item.size_m).tolist())
    turned = item.turned
    if turned is not None:
        width, height, depth = turned.size_m
        turned = turned._replace(size_m=(SMALLEST * width, height, SMALLEST * depth))
    return replace(smaller, turned=turned)


def free_offset(
    boxes: Boxes, taken: Boxes, floor: shapely.Geometry | None
) -> Float[np.ndarray, "2"] | None:
    """The shortest move along x and z after which no box overlaps a taken box, and no larger area
    lies outside the floor; None if there is no such move within `REACH_M`."""
    still = np.zeros((1, 2))
    if not _overlaps(boxes, taken, still, -TOUCHING_M)[0]:
        return still[0]
    moves = []  # along one axis, after which a box is flush with a taken box
    for axis in (0, 2):
        after = taken[None, :, 1, axis] - boxes[:, None, 0, axis] + GAP_M
        before = taken[None, :, 0, axis] - boxes[:, None, 1, axis] - GAP_M
        along = np.concatenate([after.ravel(), before.ravel()])
        along = np.unique(along[np.abs(along) <= REACH_M].round(4))
        columns = [along, np.zeros_like(along)]
        moves.append(np.stack(columns if axis == 0 else columns[::-1], axis=1))
    steps = np.arange(-REACH_M, REACH_M + STEP_M / 2, STEP_M)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    tried = np.concatenate([*moves, grid])
    tried = tried[np.argsort(np.abs(tried).sum(axis=1), kind="stable")]
    outside = _area_outside(boxes, floor, still[0])
    for some in np.array_split(tried, max(1, len(tried) // 256)):
        for offset in some[~_overlaps(boxes, taken, some, GAP_M / 2)]:
            if _area_outside(boxes, floor, offset) <= outside + 1e-4:
                return np.asarray(offset)
    return None


def _overlaps(
    boxes: Boxes, taken: Boxes, offsets: Float[np.ndarray, "moves 2"], gap_m: float
) -> Bool[np.ndarray, " moves"]:
    """True for moves after which some box is nearer than `gap_m` to a taken box."""
    level = np.minimum(boxes[:, None, 1, 1], taken[None, :, 1, 1]) - np.maximum(
        boxes[:, None, 0, 1], taken[None, :, 0, 1]
    )
    mine, theirs = np.nonzero(level > TOUCHING_M)
    found = np.zeros(len(offsets), bool)
    if not len(mine):
        return found
    low, high = boxes[mine, 0][:, ::2], boxes[mine, 1][:, ::2]
    other_low, other_high = taken[theirs, 0][:, ::2], taken[theirs, 1][:, ::2]
    moves = offsets[:, None]
    deep = np.minimum(high + moves, other_high) - np.maximum(low + moves, other_low)
    return np.asarray((deep > -gap_m).all(axis=2).any(axis=1))


def _area_outside(
    boxes: Boxes, floor: shapely.Geometry | None, offset: Float[np.ndarray, "2"]
) -> float:
    """Area of the object's bounding rectangle, after a move, that lies outside the floor."""
    if floor is None:
        return 0.0
    low, high = boxes[:, 0].min(axis=0)[::2] + offset, boxes[:, 1].max(axis=0)[::2] + offset
    return float(shapely.box(*low, *high).difference(floor).area)


CONTACT_M = 1e-3
"""Height above the lowest point up to which a body touches the floor."""
MARGIN = 0.2
"""Minimum distance of the centre of mass from the edge of the support polygon, as a share of the
distance of the centre of mass from the outline of the object seen from above."""
WIDE_M = 0.05
"""Width of a foot."""
LOWER = 0.2
"""Lower part of a body, as a share of its height, that a foot may support."""
HIGH = 0.3
"""Weight of the height of a body above the floor, relative to its horizontal distance from the
corner, when choosing the body that a foot supports."""
INTO_M = 0.01
"""Length by which a foot reaches into the body above it."""


def add_supports(item: SceneObject) -> SceneObject:
    """The object, with feet near its four corners if it would fall over without them.

    Feet are boxes, added to the object's solids and mesh. A corner near which a body already stands
    on the floor gets none.
    """
    if is_stable(item):
        return item
    bodies = colliders(item)
    if not (feet := _feet(bodies)):
        return item
    mesh = item.mesh and join_meshes([item.mesh, *map(mesh_of, feet)])
    textured = item.textured and (*item.textured, *(Textured(mesh_of(foot)) for foot in feet))
    return replace(item, solids=(*bodies, *feet), mesh=mesh, textured=textured)


def is_stable(item: SceneObject) -> bool:
    """True if the centre of mass lies inside the object's support polygon, which is the convex hull
    of its contacts with the floor seen from above, with a margin (`MARGIN`)."""
    bodies = colliders(item)
    points = np.concatenate([points_of(body) for body in bodies])
    low = points[points[:, 1] <= points[:, 1].min() + CONTACT_M][:, ::2]
    support, plan = (
        shapely.convex_hull(shapely.MultiPoint(each)) for each in (low, points[:, ::2])
    )
    volumes, centers = zip(*(volume_and_centroid(body) for body in bodies), strict=True)
    middle = shapely.Point(
        np.average(np.array(centers), axis=0, weights=np.maximum(volumes, LEAST_M3))[::2]
    )
    if not support.area or not support.contains(middle):  # without area: an edge or a tip
        return False
    return bool(middle.distance(support.exterior) >= MARGIN * middle.distance(plan.exterior))


def _feet(bodies: tuple[Solid | Mesh, ...]) -> tuple[Solid, ...]:
    """Boxes near the corners of an object. Each supports the body with the lowest cost, which
    favours low bodies near the corner."""
    clouds = [points_of(body) for body in bodies]
    floor_m = min(float(points[:, 1].min()) for points in clouds)
    every = np.concatenate(clouds)
    low, high = every[:, ::2].min(axis=0), every[:, ::2].max(axis=0)
    half = np.minimum(WIDE_M, (high - low) / 4) / 2
    # Only the lower parts, because the rim of a round body may be as high as the object.
    lower = [
        points[points[:, 1] <= points[:, 1].min() + LOWER * np.ptp(points[:, 1])]
        for points in clouds
    ]
    plans = [shapely.convex_hull(shapely.MultiPoint(points[:, ::2])) for points in lower]
    feet = []
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        at = shapely.Point(np.where(corner, high - half, low + half))
        found = []
        for points, plan in zip(lower, plans, strict=True):
            place = shapely.get_coordinates(shapely.shortest_line(at, plan))[-1]
            away = np.abs(place - [at.x, at.y]).sum()
            cost = float(away + HIGH * (points[:, 1].min() - floor_m))
            found.append((cost, place, float(points[:, 1].max())))
        _, place, top_m = min(found, key=lambda one: one[0])
        if top_m - floor_m > CONTACT_M:  # or else a body stands on the floor there
            (x0, z0), (x1, z1) = (place - half).tolist(), (place + half).tolist()
            feet.append(Solid("box", (x0, floor_m, z0), (x1, top_m + INTO_M, z1)))
    return tuple(feet)

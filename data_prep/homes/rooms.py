"""Samples empty rooms, and checks that a furnished room is walkable."""

import numpy as np
from shapely import box
from shapely.geometry import Point, Polygon
from shapely.ops import unary_union

from data_prep.homes.layout import Plan, Rect

DOOR_M = 0.9
"""Width of a door, and depth of the clear floor in front of it."""

FREE_SHARE = 0.45
"""Minimum share of the floor without furniture."""

SHOULDERS_M = 0.2
"""Half of the minimum width of a passage."""


def empty_room(
    rng: np.random.Generator, area_m2: float, sides_m: tuple[float, float], l_shaped_chance: float
) -> Plan:
    """Sample a rectangular or L-shaped room of about this area, with a door.

    The sides of its bounding rectangle lie within `sides_m`.
    """
    aspect = rng.uniform(1.0, 1.55)
    long = float(np.clip(np.sqrt(area_m2 * aspect), *sides_m))
    short = float(np.clip(area_m2 / long, *sides_m))
    width, depth = (long, short) if rng.random() < 0.5 else (short, long)
    width, depth = round(width, 2), round(depth, 2)
    notch = None
    if rng.random() < l_shaped_chance and short > sides_m[0] + 0.4:
        notch_x = round(width * rng.uniform(0.15, 0.35), 2)
        notch_z = round(depth * rng.uniform(0.15, 0.35), 2)
        x0 = 0.0 if rng.random() < 0.5 else round(width - notch_x, 2)
        z0 = 0.0 if rng.random() < 0.5 else round(depth - notch_z, 2)
        notch = (x0, z0, round(x0 + notch_x, 2), round(z0 + notch_z, 2))
    plan = Plan(width, depth, round(float(rng.uniform(2.6, 3.0)), 2), notch)
    plan.kept_clear.append(_door(plan, rng))
    return plan


def _door(plan: Plan, rng: np.random.Generator) -> Rect:
    """Sample a door near one end of a wall; returns the floor to keep clear in front of it."""
    walls = [wall for wall in plan.walls if wall.length > 1.8]
    wall = walls[rng.integers(len(walls))]
    middle = 0.1 + DOOR_M / 2
    if rng.random() < 0.5:
        middle = wall.length - middle
    x, z = wall.point(middle, DOOR_M / 2)
    return x - DOOR_M / 2, z - DOOR_M / 2, x + DOOR_M / 2, z + DOOR_M / 2


def is_liveable(plan: Plan, reach: tuple[str, ...]) -> bool:
    """Test whether enough floor is free and each class in `reach` is reachable from the door."""
    standing = [piece for piece in plan.pieces if piece.y == 0]
    covered = sum(piece.size_m[0] * piece.size_m[2] for piece in standing)
    if covered > (1 - FREE_SHARE) * plan.area:
        return False
    floor = Polygon(plan.outline).buffer(-SHOULDERS_M, join_style="mitre")
    shapes = [box(*piece.rect) for piece in standing]
    walkable = floor - unary_union(shapes).buffer(SHOULDERS_M, join_style="mitre")
    door = plan.kept_clear[0]
    entrance = Point((door[0] + door[2]) / 2, (door[1] + door[3]) / 2)
    areas = list(getattr(walkable, "geoms", [walkable]))
    here = next((area for area in areas if area.contains(entrance)), None)
    if here is None:
        return False
    at_hand = here.buffer(2.5 * SHOULDERS_M)
    return all(
        at_hand.intersects(shape)
        for piece, shape in zip(standing, shapes, strict=True)
        if piece.model.name in reach
    )

"""Places a dining table away from the walls, surrounded by identical chairs just clear of it."""

import numpy as np

from data_prep.homes.layout import Piece, Plan
from data_prep.homes.placement import Furnisher

CHAIR_ANGLED = 0.12
"""Chance that a dining chair is rotated off the axes."""


def place_dining(room: Furnisher, group: str) -> bool:
    """Place "dining 6", a table with six chairs, preferably not in front of the sofa."""
    plan, rng = room.plan, room.rng
    count = int(group.split(" ")[1])
    tables = room.models("table", above=1.5 if count > 4 else 1.0)
    chairs = [model for model in room.models("chair", below=0.68) if model.size_m[2] < 0.72]
    for attempt in range(40):
        table, chair = room.pick(tables), room.pick(chairs)
        yaw = float(rng.integers(4)) * np.pi / 2
        half_x, half_z = table.half_extent(yaw)
        around = chair.model.size_m[2] + 0.1
        if 2 * (half_x + around) > plan.width or 2 * (half_z + around) > plan.depth:
            continue
        x = rng.uniform(half_x + around, plan.width - half_x - around)
        z = rng.uniform(half_z + around, plan.depth - half_z - around)
        table = table.at(x, z, yaw)
        if attempt < 30 and _is_before(room.anchor, table):
            continue
        places = _chair_places(table, chair.size_m[0], count)
        if len(places) < count or not plan.fits(table):
            continue
        ring = [_chair_at(room, table, chair, *place) for place in places]
        if not all(plan.fits(piece) for piece in ring):
            continue
        trial = Plan(plan.width, plan.depth, plan.height, plan.notch, [table])
        if all([trial.add(piece) for piece in ring]):
            plan.pieces += [table, *ring]
            return True
    return False


def _is_before(sofa: Piece, table: Piece) -> bool:
    """Test whether the table stands in front of the sofa."""
    sin, cos = np.sin(sofa.yaw_rad), np.cos(sofa.yaw_rad)
    dx, dz = table.x - sofa.x, table.z - sofa.z
    half = table.half_extent(table.yaw_rad - sofa.yaw_rad)[0]
    sideways, forward = abs(dx * cos - dz * sin), dx * sin + dz * cos
    return sideways < half + 0.4 * sofa.size_m[0] and forward < 4.0


def _chair_places(table: Piece, width: float, count: int) -> list[tuple[float, float]]:
    """Places (rotation, sideways) of up to `count` chairs: long sides in pairs, then the ends."""
    long = int((table.size_m[0] + 0.05) // (width + 0.06))
    row = max(1, min(long, count // 2 if count <= 4 else (count - 1) // 2))
    step = table.size_m[0] / row
    sides = [(turn, (k + 0.5 - row / 2) * step) for k in range(row) for turn in (0.0, np.pi)]
    ends = [(np.pi / 2, 0.0), (-np.pi / 2, 0.0)] if table.size_m[2] > 0.6 else []
    return (sides + ends)[:count]


def _chair_at(room: Furnisher, table: Piece, chair: Piece, turn: float, sideways: float) -> Piece:
    towards = table.yaw_rad + turn
    askew = room.random_turn(CHAIR_ANGLED) * 0.6
    half = table.size_m[2] / 2 if abs(np.cos(turn)) > 0.5 else table.size_m[0] / 2
    off = half + chair.half_extent(askew)[1] + room.rng.uniform(0.02, 0.07)
    sin, cos = np.sin(towards), np.cos(towards)
    x = table.x + off * sin + sideways * cos
    z = table.z + off * cos - sideways * sin
    return chair.at(x, z, towards + np.pi + askew)

"""A dining table out on the floor, ringed by equal chairs that stand just clear of it."""

import numpy as np

from data_prep.homes.catalog import Model, Shop
from data_prep.homes.layout import Piece, Plan, Vector, half_extent, scaled
from data_prep.homes.moves import some_scale, some_turn

CHAIR_ANGLED = 0.12
"""Chance that a dining chair was left askew."""


def place_dining(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, sofa: Piece) -> bool:
    """ "dining 6": a table with six chairs, rather not between the sofa and what it faces."""
    count = int(wish.split(" ")[1])
    tables = [model for model in shop["table"] if model.size_m[0] > (1.5 if count > 4 else 1.0)]
    chairs = [model for model in shop["chair"] if model.size_m[0] < 0.68 and model.size_m[2] < 0.72]
    for attempt in range(40):
        model, scale = tables[rng.integers(len(tables))], some_scale(rng)
        chair, chair_scale = chairs[rng.integers(len(chairs))], some_scale(rng)
        yaw = float(rng.integers(4)) * np.pi / 2
        size = scaled(model, scale)
        half_x, half_z = half_extent(size, yaw)
        around = chair.size_m[2] + 0.1
        if 2 * (half_x + around) > plan.width or 2 * (half_z + around) > plan.depth:
            continue
        x = rng.uniform(half_x + around, plan.width - half_x - around)
        z = rng.uniform(half_z + around, plan.depth - half_z - around)
        table = Piece(model, float(x), float(z), yaw, scale)
        if attempt < 30 and _before_sofa(table, sofa):
            continue
        places = _chair_places(table, chair.size_m[0] * chair_scale[0], count)
        if len(places) < count or not plan.fits(table):
            continue
        ring = [_chair_at(table, chair, chair_scale, place, rng) for place in places]
        if not all(plan.fits(piece) for piece in ring):
            continue
        trial = Plan(plan.width, plan.depth, plan.height, plan.notch, [table])
        if all([trial.add(piece) is not None for piece in ring]):
            plan.pieces += [table, *ring]
            return True
    return False


def _before_sofa(table: Piece, sofa: Piece) -> bool:
    """Whether the table stands where those on the sofa look."""
    sin, cos = np.sin(sofa.yaw_rad), np.cos(sofa.yaw_rad)
    dx, dz = table.x - sofa.x, table.z - sofa.z
    half = half_extent(table.size_m, table.yaw_rad - sofa.yaw_rad)[0]
    sideways, forward = abs(dx * cos - dz * sin), dx * sin + dz * cos
    return sideways < half + 0.4 * sofa.size_m[0] and forward < 4.0


def _chair_places(table: Piece, width: float, count: int) -> list[tuple[float, float]]:
    """(turn, sideways) of up to `count` chairs: the long sides in pairs, then the ends."""
    long = int((table.size_m[0] + 0.05) // (width + 0.06))
    row = min(long, count // 2 if count <= 4 else (count - 2 + 1) // 2)
    row = max(row, 1)
    step = table.size_m[0] / row
    sides = [(turn, (k + 0.5 - row / 2) * step) for k in range(row) for turn in (0.0, np.pi)]
    ends = [(np.pi / 2, 0.0), (-np.pi / 2, 0.0)] if table.size_m[2] > 0.6 else []
    return (sides + ends)[:count]


def _chair_at(
    table: Piece, model: Model, scale: Vector, place: tuple[float, float], rng: np.random.Generator
) -> Piece:
    turn, sideways = place
    towards = table.yaw_rad + turn
    askew = some_turn(rng, CHAIR_ANGLED) * 0.6
    size = scaled(model, scale)
    reach = half_extent(size, askew)[1]
    half = table.size_m[2] / 2 if abs(np.cos(turn)) > 0.5 else table.size_m[0] / 2
    off = half + reach + rng.uniform(0.02, 0.07)
    sin, cos = np.sin(towards), np.cos(towards)
    x = table.x + off * sin + sideways * cos
    z = table.z + off * cos - sideways * sin
    return Piece(model, float(x), float(z), float(towards + np.pi + askew), scale)

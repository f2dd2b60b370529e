"""The moves that every rule of furnishing is made of: each tries, and says what it placed."""

import numpy as np

from data_prep.homes.catalog import Model, Shop
from data_prep.homes.layout import Piece, Plan, Vector, Wall, half_extent, scaled


def some_scale(rng: np.random.Generator) -> Vector:
    """Nobody's cupboard is exactly the catalogue's: a few percent along each axis."""
    x, y, z = np.clip(rng.normal(1.0, 0.035, 3), 0.92, 1.08).round(4).tolist()
    return x, y, z


def some_turn(rng: np.random.Generator, chance: float) -> float:
    """With this chance 10 to 40 degrees to either side, else none."""
    if rng.random() >= chance:
        return 0.0
    return float(np.radians(rng.uniform(10, 40)) * rng.choice([-1, 1]))


def against_wall(
    plan: Plan,
    rng: np.random.Generator,
    models: list[Model],
    apron: float = 0.0,
    walls: list[Wall] | None = None,
    corner: float = 0.45,
    tries: int = 40,
    where: float | None = None,
) -> Piece | None:
    """A piece with its back to a wall; `corner` is the chance to try the wall's ends.

    Args:
        apron: Metres that stay clear before it.
        walls: Only these; all of the plan's if None.
        where: Metres along the wall where its middle should come, give or take 0.3.
    """
    walls = plan.walls if walls is None else walls
    lengths = np.array([wall.length for wall in walls])
    for _ in range(tries):
        model, scale = models[rng.integers(len(models))], some_scale(rng)
        wall = walls[rng.choice(len(walls), p=lengths / lengths.sum())]
        width, depth = model.size_m[0] * scale[0], model.size_m[2] * scale[2]
        slack = wall.length - width
        if slack < 0.04:
            continue
        start = rng.uniform(0.01, slack - 0.01)
        if where is not None:
            start = np.clip(where - width / 2 + rng.normal(0, 0.15), 0.01, slack - 0.01)
        elif rng.random() < corner:
            start = rng.choice([0.02, slack - 0.02])
        along = start + width / 2
        off = depth / 2 + rng.uniform(0.006, 0.025)
        x = wall.x + wall.along[0] * along - wall.along[1] * off
        z = wall.z + wall.along[1] * along + wall.along[0] * off
        piece = plan.add(Piece(model, float(x), float(z), wall.yaw_rad, scale), apron)
        if piece:
            return piece
    return None


def before(
    plan: Plan,
    rng: np.random.Generator,
    anchor: Piece,
    models: list[Model],
    gap: tuple[float, float],
    facing: float = np.pi,
    sideways: tuple[float, float] = (-0.1, 0.1),
    angled: float = 0.0,
    tries: int = 15,
) -> Piece | None:
    """A piece in front of another, `gap` metres off; by default it looks back at it."""
    for _ in range(tries):
        model, scale = models[rng.integers(len(models))], some_scale(rng)
        yaw = anchor.yaw_rad + facing + some_turn(rng, angled)
        size = scaled(model, scale)
        reach = half_extent(size, yaw - anchor.yaw_rad)[1]
        off = anchor.size_m[2] / 2 + rng.uniform(*gap) + reach
        x, z = anchor.ahead(off, rng.uniform(*sideways))
        piece = plan.add(Piece(model, x, z, float(yaw), scale), crowding=True)
        if piece:
            return piece
    return None


def beside(
    plan: Plan,
    rng: np.random.Generator,
    anchor: Piece,
    model: Model,
    scale: Vector,
    side: int,
    gap: tuple[float, float] = (0.02, 0.12),
) -> Piece | None:
    """A piece at the anchor's side (+1: its own +x), their backs on one line."""
    for _ in range(4):
        width, depth = model.size_m[0] * scale[0], model.size_m[2] * scale[2]
        off = anchor.size_m[0] / 2 + width / 2 + rng.uniform(*gap)
        x, z = anchor.ahead((depth - anchor.size_m[2]) / 2, side * off)
        piece = plan.add(Piece(model, x, z, anchor.yaw_rad, scale), crowding=True)
        if piece:
            return piece
    return None


def standing_free(
    plan: Plan,
    rng: np.random.Generator,
    models: list[Model],
    angled: float,
    towards: tuple[float, float] | None = None,
    tries: int = 40,
) -> Piece | None:
    """A light piece near a wall or a corner, turned to a point or along the room's axes."""
    for _ in range(tries):
        model, scale = models[rng.integers(len(models))], some_scale(rng)
        half = max(model.size_m[0], model.size_m[2]) / 2
        along = rng.uniform(half, plan.width - half), rng.uniform(half, plan.depth - half)
        edge = rng.integers(4)
        near = half + rng.uniform(0.06, 0.35)
        x = (near, plan.width - near, along[0], along[0])[edge]
        z = (along[1], along[1], near, plan.depth - near)[edge]
        yaw = float(rng.integers(4)) * np.pi / 2
        if towards is not None:
            exact = np.arctan2(towards[0] - x, towards[1] - z)
            yaw = float(np.round(exact / (np.pi / 2)) * np.pi / 2)
        piece = plan.add(Piece(model, x, z, yaw + some_turn(rng, angled), scale))
        if piece:
            return piece
    return None


def hung(
    plan: Plan,
    rng: np.random.Generator,
    models: list[Model],
    x: float,
    z: float,
    lowest: float,
    angled: float,
    yaw_rad: float = 0.0,
) -> Piece | None:
    """A lamp whose top touches the ceiling above (x, z) and whose bottom stays over `lowest`."""
    for _ in range(20):
        model, scale = models[rng.integers(len(models))], some_scale(rng)
        bottom = plan.height - model.size_m[1] * scale[1]
        if bottom < lowest:
            continue
        yaw = yaw_rad + some_turn(rng, angled)
        at = x + rng.normal(0, 0.05), z + rng.normal(0, 0.05)
        piece = plan.add(Piece(model, float(at[0]), float(at[1]), float(yaw), scale, bottom))
        if piece:
            return piece
    return None


def opposite(
    plan: Plan, rng: np.random.Generator, anchor: Piece, models: list[Model]
) -> Piece | None:
    """Against the wall that the anchor looks at, on its axis."""
    facing = [
        wall
        for wall in plan.walls
        if np.cos(wall.yaw_rad - anchor.yaw_rad) < -0.9 and wall.length > 1.5
    ]
    if not facing:
        return None
    wall = max(facing, key=lambda wall: wall.length)
    where = abs(wall.along[0]) * abs(anchor.x - wall.x) + abs(wall.along[1]) * abs(
        anchor.z - wall.z
    )
    return against_wall(plan, rng, models, walls=[wall], where=where, tries=15)


def pair_along_wall(
    plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, angled: float
) -> bool:
    """ "desk and chair": the first along a wall, the second before it, looking at it."""
    first, _, seat = wish.partition(" and ")
    if not seat:
        return against_wall(plan, rng, shop[first], apron=0.5) is not None
    table = against_wall(plan, rng, shop[first], apron=0.75)
    if table is None:
        return False
    seats = [model for model in shop[seat] if model.size_m[0] < 0.75]
    return before(plan, rng, table, seats, (0.02, 0.12), angled=angled) is not None


def lamp_place(plan: Plan) -> tuple[float, float]:
    """The middle of the largest rectangle of the floor."""
    if plan.notch is None:
        return plan.width / 2, plan.depth / 2
    x0, z0, x1, z1 = plan.notch
    beside_x = (x1, plan.width) if x0 == 0 else (0.0, x0)
    beside_z = (z1, plan.depth) if z0 == 0 else (0.0, z0)
    if (beside_x[1] - beside_x[0]) * plan.depth > (beside_z[1] - beside_z[0]) * plan.width:
        return sum(beside_x) / 2, plan.depth / 2
    return plan.width / 2, sum(beside_z) / 2

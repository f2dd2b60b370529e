"""How a living room is furnished: a number of pieces in, a plan out."""

from collections.abc import Callable

import numpy as np

from data_prep.homes.catalog import Shop
from data_prep.homes.dining import place_dining
from data_prep.homes.layout import Piece, Plan, half_extent
from data_prep.homes.moves import (
    against_wall,
    before,
    beside,
    hung,
    lamp_place,
    opposite,
    pair_along_wall,
    some_scale,
    standing_free,
)
from data_prep.homes.rooms import count_at, empty_room, is_liveable

COUNTS = {4: 40, 5: 65, 6: 90, 7: 110, 8: 120, 9: 120, 10: 110, 11: 95, 12: 78, 13: 60, 14: 44,
          15: 32, 16: 23, 17: 16, 18: 11, 19: 8, 20: 5, 21: 3}  # fmt: skip
"""Pieces in a room -> weight: mean 9.8, at most ATISS's 21. Ours: we know no real histogram."""

SEAT_ANGLED = 0.55
LAMP_ANGLED = 0.12

EXTRAS: dict[str, tuple[int, float]] = {
    "armchair": (1, 0.5),
    "side tables 1": (1, 0.45),
    "side tables 2": (2, 0.25),
    "stool": (1, 0.3),
    "cabinet": (1, 0.55),
    "bookshelf": (1, 0.22),
    "shelf": (1, 0.16),
    "wardrobe": (1, 0.06),
    "desk and chair": (2, 0.12),
    "lamp": (1, 0.35),
    "sofa": (1, 0.15),
    "chair": (1, 0.1),
}
"""What joins sofa, coffee table, TV stand and dining table: pieces, weight."""


def furnish_living_room(shop: Shop, rng: np.random.Generator, share: float) -> Plan:
    """A living room, arranged and walkable; this share of living rooms has fewer pieces."""
    count = count_at(COUNTS, share)
    for attempt in range(400):
        if attempt % 8 == 0:
            wishes = wish_list(rng, count)
        area = (10.0 + 1.9 * count) * rng.uniform(0.85, 1.2) * (1 + 0.02 * min(attempt, 40))
        plan = empty_room(rng, area, 3.2, 12.0, l_shaped_chance=0.15)
        if arrange(plan, shop, rng, wishes) and is_liveable(
            plan, reach=("sofa", "table", "cabinet")
        ):
            return plan
    raise RuntimeError(f"No living room with {count} pieces found room in 400 tries: {wishes}.")


def wish_list(rng: np.random.Generator, count: int) -> list[str]:
    """What to place, in order of placing; names of groups whose pieces add up to `count`."""
    wishes, left = ["lounge"], count - 1
    dining = 0.85 if count > 6 else 0.45
    chairs = int(rng.choice([2, 4, 6, 8], p=[0.15, 0.45, 0.3, 0.1]))
    chairs = min(chairs, left - 3)
    basics = [("tv_stand", 1, 0.85), ("coffee_table", 1, 0.9), ("lamp", 1, 0.85)]
    if chairs >= 2:
        basics.append((f"dining {chairs}", 1 + chairs, dining))
    for name, pieces, chance in [basics[k] for k in rng.permutation(len(basics))]:
        if pieces <= left and rng.random() < chance:
            wishes.append(name)
            left -= pieces
    offers = dict(EXTRAS)
    while left:
        fitting = [name for name, (pieces, _) in offers.items() if pieces <= left]
        if not fitting:
            offers = {
                name: EXTRAS[name] for name in ("armchair", "cabinet", "shelf", "lamp", "stool")
            }
            continue
        weights = np.array([offers[name][1] for name in fitting])
        chosen = str(rng.choice(fitting, p=weights / weights.sum()))
        wishes.append(chosen)
        left -= offers[chosen][0]
        twice = chosen in ("armchair", "cabinet", "lamp") and wishes.count(chosen) < 2
        if not twice:
            first = chosen.split(" ")[0]
            offers = {name: offer for name, offer in offers.items() if name.split(" ")[0] != first}
    return sorted(wishes, key=lambda wish: _PLACING_ORDER.index(wish.split(" ")[0]))


_PLACING_ORDER = (
    "lounge", "coffee_table", "tv_stand", "dining", "side", "sofa", "armchair", "wardrobe", "desk",
    "bookshelf", "cabinet", "stool", "shelf", "chair", "lamp",
)  # fmt: skip


def arrange(plan: Plan, shop: Shop, rng: np.random.Generator, wishes: list[str]) -> bool:
    """Place all wishes; False as soon as one finds no place."""
    walls = sorted(plan.walls, key=lambda wall: -wall.length)[:4]
    wall = walls[rng.integers(len(walls))]
    share = rng.uniform(0.35, 0.65)
    if any(wish.startswith("dining") for wish in wishes):  # leave one end to the table
        share = rng.choice([0.0, 1.0]) + rng.uniform(-0.3, 0.3)
    sofa = against_wall(
        plan, rng, shop["sofa"], 0.5, [wall], where=wall.length * float(share), tries=10
    )
    return sofa is not None and all(
        _RULES.get(wish.split(" ")[0], _along_wall)(plan, shop, rng, wish, sofa)
        for wish in wishes[1:]
    )


def _coffee_table(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, sofa: Piece) -> bool:
    tables = [model for model in shop["coffee_table"] if model.size_m[0] < 0.8 * sofa.size_m[0]]
    return before(plan, rng, sofa, tables, (0.3, 0.45), angled=0.05) is not None


def _tv_stand(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, sofa: Piece) -> bool:
    return opposite(plan, rng, sofa, shop["tv_stand"]) is not None


def _side_tables(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, sofa: Piece) -> bool:
    small = [model for model in shop["table"] if model.size_m[0] < 0.75]
    model, scale = small[rng.integers(len(small))], some_scale(rng)
    sides = [int(side) for side in rng.permutation([-1, 1])]
    if wish.endswith("2"):
        return all([beside(plan, rng, sofa, model, scale, side) for side in sides])
    if any(beside(plan, rng, sofa, model, scale, side) for side in sides):
        return True
    return standing_free(plan, rng, small, 0.1) is not None


def _armchair(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, sofa: Piece) -> bool:
    """Beside the coffee table, looking at it, or near a wall."""
    tables = [piece for piece in plan.pieces if piece.model.name == "coffee_table"]
    for side in rng.permutation([-1, 1]) if tables else ():
        table = tables[0]
        anchor = Piece(table.model, table.x, table.z, sofa.yaw_rad + side * np.pi / 2,
                       (table.scale[2] * table.size_m[2] / table.size_m[0], 1.0, 1.0))  # fmt: skip
        reach = half_extent(table.size_m, table.yaw_rad - anchor.yaw_rad)[1]
        gap = reach - anchor.size_m[2] / 2
        if before(plan, rng, anchor, shop["armchair"], (gap + 0.25, gap + 0.5),
                  angled=SEAT_ANGLED, sideways=(-0.3, 0.3), tries=6):  # fmt: skip
            return True
    return standing_free(plan, rng, shop["armchair"], SEAT_ANGLED, (sofa.x, sofa.z)) is not None


def _desk(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, sofa: Piece) -> bool:
    return pair_along_wall(plan, shop, rng, wish, SEAT_ANGLED)


def _second_sofa(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, sofa: Piece) -> bool:
    """A short one along another wall."""
    short = [model for model in shop["sofa"] if model.size_m[0] < 2.2]
    across = [wall for wall in plan.walls if abs(np.cos(wall.yaw_rad - sofa.yaw_rad)) < 0.5]
    return against_wall(plan, rng, short, 0.4, across) is not None


def _light(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, sofa: Piece) -> bool:
    """Over the dining table first, then over the coffee table, then over the room's middle."""
    hanging = [piece for piece in plan.pieces if piece.y > 0]
    tables = [
        piece
        for piece in plan.pieces
        if (piece.model.name == "table" and piece.size_m[0] > 0.95)
        or piece.model.name == "coffee_table"
    ]
    tables.sort(key=lambda piece: piece.model.name, reverse=True)
    if len(hanging) < len(tables) and rng.random() < 0.8:
        table = tables[len(hanging)]
        lowest = table.top + 0.6
        if hung(
            plan, rng, shop["pendant_lamp"], table.x, table.z, lowest, LAMP_ANGLED, table.yaw_rad
        ):
            return True
    x, z = lamp_place(plan)
    if hanging:
        x, z = x + rng.uniform(-0.25, 0.25) * plan.width, z + rng.uniform(-0.25, 0.25) * plan.depth
    kind = "ceiling_lamp" if rng.random() < 0.55 else "pendant_lamp"
    return hung(plan, rng, shop[kind], x, z, 1.7, LAMP_ANGLED) is not None


def _loose(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, sofa: Piece) -> bool:
    small = [model for model in shop[wish] if model.size_m[0] < 0.9]
    return standing_free(plan, rng, small, SEAT_ANGLED, (sofa.x, sofa.z)) is not None


def _along_wall(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, sofa: Piece) -> bool:
    return against_wall(plan, rng, shop[wish], 0.4) is not None


_RULES: dict[str, Callable[[Plan, Shop, np.random.Generator, str, Piece], bool]] = {
    "coffee_table": _coffee_table,
    "tv_stand": _tv_stand,
    "dining": place_dining,
    "side": _side_tables,
    "sofa": _second_sofa,
    "armchair": _armchair,
    "desk": _desk,
    "stool": _loose,
    "chair": _loose,
    "lamp": _light,
}

"""How a bedroom is furnished: a number of pieces in, a plan out."""

from collections.abc import Callable

import numpy as np

from data_prep.homes.catalog import Shop
from data_prep.homes.layout import Piece, Plan
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

COUNTS = {2: 157, 3: 782, 4: 1731, 5: 2057, 6: 1296, 7: 821, 8: 419, 9: 234, 10: 112, 11: 58,
          12: 21, 13: 7}  # fmt: skip
"""Pieces in a room -> how many of the authors' 7,835 bedrooms have so many; those of one piece
and of more than 13 are left out there, too."""

BEDS = {"double_bed": 0.70, "single_bed": 0.18, "kids_bed": 0.12}

ANGLED = 0.8
"""Chance that a seat or a stool stands askew; it makes one piece in ten of them all."""
LAMP_ANGLED = 0.3

EXTRAS: dict[str, tuple[int, float]] = {
    "tv_stand": (1, 0.34),
    "cabinet": (1, 0.30),
    "desk and chair": (2, 0.24),
    "dressing_table": (1, 0.10),
    "dressing_table and dressing_chair": (2, 0.16),
    "dressing_table and stool": (2, 0.07),
    "armchair": (1, 0.13),
    "armchair and table": (2, 0.08),
    "armchair and coffee_table": (2, 0.07),
    "bookshelf": (1, 0.12),
    "shelf": (1, 0.10),
    "bench": (1, 0.14),
    "table": (1, 0.08),
    "chair": (1, 0.06),
    "sofa": (1, 0.05),
    "sofa and coffee_table": (2, 0.06),
    "children_cabinet": (1, 0.08),
    "bedside lamps": (2, 0.10),
}
"""What stands in a bedroom beyond bed, nightstands, wardrobe and lamp: pieces, weight."""


def furnish_bedroom(shop: Shop, rng: np.random.Generator, share: float) -> Plan:
    """A bedroom with a bed, arranged and walkable; this share of bedrooms has fewer pieces."""
    count = count_at(COUNTS, share)
    bed = str(rng.choice(list(BEDS), p=list(BEDS.values())))
    for attempt in range(400):
        if attempt % 8 == 0:
            wishes = wish_list(rng, count, bed)
        area = (7.5 + 1.35 * count) * rng.uniform(0.85, 1.2) * (1 + 0.02 * min(attempt, 30))
        plan = empty_room(rng, area, 2.7, 6.0, l_shaped_chance=0.12)
        if arrange(plan, shop, rng, wishes) and is_liveable(plan, reach=(bed, "wardrobe", "desk")):
            return plan
    raise RuntimeError(f"No bedroom with {count} pieces found room in 400 tries: {wishes}.")


def wish_list(rng: np.random.Generator, count: int, bed: str) -> list[str]:
    """What to place, in order of placing; names of groups whose pieces add up to `count`."""
    wishes, left = [bed], count - 1
    nights = rng.choice(
        [2, 1, 0], p=[0.62, 0.24, 0.14] if bed == "double_bed" else [0.1, 0.55, 0.35]
    )
    store = "children_cabinet" if bed == "kids_bed" and rng.random() < 0.5 else "wardrobe"
    basics = [("lamp", 1, 0.88), ("nightstands", nights, 1.0), (store, 1, 0.82)]
    for name, pieces, chance in [basics[k] for k in rng.permutation(3)]:
        if 0 < pieces <= left and rng.random() < chance:
            wishes.append(name if name != "nightstands" else f"nightstands {pieces}")
            left -= int(pieces)
    offers = {name: offer for name, offer in EXTRAS.items() if name not in wishes}
    if "nightstands 2" not in wishes or bed != "double_bed":
        offers.pop("bedside lamps", None)
    if bed == "kids_bed":
        offers = {name: offer for name, offer in offers.items() if "dressing" not in name}
    while left:
        fitting = [name for name, (pieces, _) in offers.items() if pieces <= left]
        if not fitting:  # a large room: start the list again
            offers = {name: EXTRAS[name] for name in ("cabinet", "shelf", "table", "chair")}
            continue
        weights = np.array([offers[name][1] for name in fitting])
        chosen = str(rng.choice(fitting, p=weights / weights.sum()))
        wishes.append(chosen)
        left -= offers[chosen][0]
        first = chosen.split(" ")[0]  # one dressing table, one sofa, one desk is enough
        offers = {name: offer for name, offer in offers.items() if name.split(" ")[0] != first}
    return sorted(wishes, key=_order)


_PLACING_ORDER = (
    *BEDS, "nightstands", "tv_stand", "wardrobe", "children_cabinet", "desk", "dressing_table",
    "sofa", "bookshelf", "cabinet", "bench", "bedside", "armchair", "shelf", "table", "chair",
    "lamp",
)  # fmt: skip


def _order(wish: str) -> int:
    return _PLACING_ORDER.index(wish.split(" ")[0])


def arrange(plan: Plan, shop: Shop, rng: np.random.Generator, wishes: list[str]) -> bool:
    """Place all wishes; False as soon as one finds no place."""
    bed = _place_bed(plan, shop, rng, wishes[0], f"{wishes[1:]}".count("nightstands"))
    return bed is not None and all(
        _RULES.get(wish.split(" ")[0], _along_wall)(plan, shop, rng, wish, bed)
        for wish in wishes[1:]
    )


def _place_bed(
    plan: Plan, shop: Shop, rng: np.random.Generator, name: str, nightstands: int
) -> Piece | None:
    """Headboard on a wall: near its middle for two, often in a corner for one."""
    walls = sorted(plan.walls, key=lambda wall: -wall.length)[:4]
    wall = walls[rng.integers(len(walls))]
    if name == "double_bed" or nightstands:
        return against_wall(
            plan, rng, shop[name], 0.5, [wall], where=wall.length * rng.uniform(0.42, 0.58), tries=8
        )
    return against_wall(plan, rng, shop[name], 0.4, [wall], corner=0.75, tries=8)


def _nightstands(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, bed: Piece) -> bool:
    model, scale = shop["nightstand"][rng.integers(len(shop["nightstand"]))], some_scale(rng)
    sides = rng.permutation([-1, 1])
    if wish.endswith("2"):
        return all([beside(plan, rng, bed, model, scale, int(side)) for side in sides])
    return any(beside(plan, rng, bed, model, scale, int(side)) for side in sides)


def _bedside_lamps(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, bed: Piece) -> bool:
    nights = [piece for piece in plan.pieces if piece.model.name == "nightstand"]
    small = sorted(shop["pendant_lamp"], key=lambda model: model.size_m[0])[:4]
    twin = [small[rng.integers(len(small))]]
    return all([hung(plan, rng, twin, n.x, n.z, n.top + 0.3, 0.0) for n in nights[:2]])


def _tv_stand(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, bed: Piece) -> bool:
    return opposite(plan, rng, bed, shop["tv_stand"]) is not None


def _table_and_seat(
    plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, bed: Piece
) -> bool:
    return pair_along_wall(plan, shop, rng, wish, ANGLED)


def _sofa(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, bed: Piece) -> bool:
    short = [model for model in shop["sofa"] if model.size_m[0] < 2.4]
    sofa = against_wall(plan, rng, short, apron=0.5)
    if sofa is None or not wish.endswith("coffee_table"):
        return sofa is not None
    small = [model for model in shop["coffee_table"] if model.size_m[0] < 1.3]
    return before(plan, rng, sofa, small, (0.25, 0.4)) is not None


def _bench(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, bed: Piece) -> bool:
    """At the bed's end; a small stool may stand anywhere."""
    if rng.random() < 0.6:
        long = [model for model in shop["stool"] if model.size_m[0] > 0.8]
        if before(plan, rng, bed, long, (0.03, 0.12), tries=6):
            return True
    small = [model for model in shop["stool"] if model.size_m[0] < 0.8]
    return standing_free(plan, rng, small, ANGLED) is not None


def _armchair(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, bed: Piece) -> bool:
    """Near a wall, turned to the middle of the room; perhaps a small table with it."""
    middle = (plan.width / 2, plan.depth / 2)
    chair = standing_free(plan, rng, shop["armchair"], ANGLED, middle)
    _, _, companion = wish.partition(" and ")
    if chair is None or not companion:
        return chair is not None
    small = [model for model in shop[companion] if model.size_m[0] < 0.9]
    upright = Piece(chair.model, chair.x, chair.z, round(chair.yaw_rad / (np.pi / 2)) * np.pi / 2,
                    chair.scale)  # fmt: skip
    if before(plan, rng, upright, small, (0.15, 0.35), angled=0.2, tries=6):
        return True
    return standing_free(plan, rng, small, 0.2) is not None


def _light(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, bed: Piece) -> bool:
    """Over the middle of the room, where one walks under it, or over the bed."""
    kind = "pendant_lamp" if rng.random() < 0.76 else "ceiling_lamp"
    x, z = lamp_place(plan)
    if rng.random() < 0.35:
        x, z = (x + bed.x) / 2, (z + bed.z) / 2
    if hung(plan, rng, shop[kind], x, z, 1.65, LAMP_ANGLED):
        return True
    return hung(plan, rng, shop["ceiling_lamp"], x, z, 1.65, LAMP_ANGLED) is not None


def _loose(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, bed: Piece) -> bool:
    small = [model for model in shop[wish] if model.size_m[0] < 0.8]
    return standing_free(plan, rng, small, ANGLED if wish == "chair" else 0.2) is not None


def _along_wall(plan: Plan, shop: Shop, rng: np.random.Generator, wish: str, bed: Piece) -> bool:
    apron = 0.5 if wish in ("wardrobe", "children_cabinet") else 0.35
    return against_wall(plan, rng, shop[wish], apron) is not None


_RULES: dict[str, Callable[[Plan, Shop, np.random.Generator, str, Piece], bool]] = {
    "nightstands": _nightstands,
    "bedside": _bedside_lamps,
    "tv_stand": _tv_stand,
    "desk": _table_and_seat,
    "dressing_table": _table_and_seat,
    "sofa": _sofa,
    "bench": _bench,
    "armchair": _armchair,
    "table": _loose,
    "chair": _loose,
    "lamp": _light,
}

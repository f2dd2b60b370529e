"""Samples the furniture of a bedroom and the rules that place it."""

import numpy as np

from data_prep.homes.furnish import (
    Furnisher,
    Offers,
    RoomType,
    along_wall,
    draw_basics,
    draw_extras,
    opposite_the_anchor,
    table_and_seat,
)
from data_prep.homes.layout import Piece

COUNTS = {2: 157, 3: 782, 4: 1731, 5: 2057, 6: 1296, 7: 821, 8: 419, 9: 234, 10: 112, 11: 58,
          12: 21, 13: 7}  # fmt: skip
"""Histogram of the number of pieces per room over the paper authors' 7,835 bedrooms.

Rooms with one piece or more than 13 pieces are left out here as well.
"""

BEDS = {"double_bed": 0.70, "single_bed": 0.18, "kids_bed": 0.12}

ANGLED = 0.8
"""Chance that a seat is rotated off the axes, so that one piece in ten of all furniture is."""
LAMP_ANGLED = 0.3

EXTRAS: Offers = {
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
"""Furniture of a bedroom besides bed, nightstands, wardrobe and lamp."""


def _draw_groups(rng: np.random.Generator, count: int, bed: str) -> list[str]:
    chances = [0.62, 0.24, 0.14] if bed == "double_bed" else [0.1, 0.55, 0.35]
    nightstands = int(rng.choice([2, 1, 0], p=chances))
    store = "children_cabinet" if bed == "kids_bed" and rng.random() < 0.5 else "wardrobe"
    basics = [("lamp", 1, 0.88), (f"nightstands {nightstands}", nightstands, 1.0), (store, 1, 0.82)]
    groups, left = draw_basics(rng, basics, count)
    offers = {name: offer for name, offer in EXTRAS.items() if name not in groups}
    if "nightstands 2" not in groups or bed != "double_bed":
        del offers["bedside lamps"]
    if bed == "kids_bed":
        offers = {name: offer for name, offer in offers.items() if "dressing" not in name}
    fallback = {name: EXTRAS[name] for name in ("cabinet", "shelf", "table", "chair")}
    return draw_extras(rng, groups, left, offers, fallback)


def _place_bed(room: Furnisher, groups: list[str]) -> Piece | None:
    """Place the bed with its headboard at a wall.

    Double beds and beds with nightstands stand near the middle of the wall; other beds often stand
    in a corner.
    """
    wall, models = room.long_wall(), room.catalog[groups[0]]
    if groups[0] == "double_bed" or any("nightstands" in group for group in groups):
        where = wall.length_m * room.rng.uniform(0.42, 0.58)
        return room.against_wall(models, 0.5, [wall], where=where, tries=8)
    return room.against_wall(models, 0.4, [wall], corner=0.75, tries=8)


def _bedside_lamps(room: Furnisher, group: str) -> bool:
    nightstands = [piece for piece in room.layout.pieces if piece.model.name == "nightstand"]
    small = sorted(room.catalog["pendant_lamp"], key=lambda model: model.size_m[0])[:4]
    twin = [small[room.rng.integers(len(small))]]
    return all([room.hang(twin, (n.x, n.z), n.top + 0.3, 0.0) for n in nightstands[:2]])


def _sofa(room: Furnisher, group: str) -> Piece | None:
    sofa = room.against_wall(room.models("sofa", below=2.4), clearance=0.5)
    if sofa is None or not group.endswith("coffee_table"):
        return sofa
    return room.before(sofa, room.models("coffee_table", below=1.3), (0.25, 0.4))


def _bench(room: Furnisher, group: str) -> object:
    """Place a bench at the foot of the bed, or a small stool anywhere."""
    long, small = room.models("stool", above=0.8), room.models("stool", below=0.8)
    at_foot = room.rng.random() < 0.6 and room.before(room.anchor, long, (0.03, 0.12), tries=6)
    return at_foot or room.standing_free(small, ANGLED)


def _armchair(room: Furnisher, group: str) -> Piece | None:
    """Place an armchair near a wall, facing the middle of the room, perhaps with a small table."""
    middle = (room.layout.width / 2, room.layout.depth / 2)
    chair = room.standing_free(room.catalog["armchair"], ANGLED, middle)
    _, _, companion = group.partition(" and ")
    if chair is None or not companion:
        return chair
    small = room.models(companion, below=0.9)
    upright = chair.at(chair.x, chair.z, round(chair.yaw_rad / (np.pi / 2)) * np.pi / 2)
    before = room.before(upright, small, (0.15, 0.35), angled=0.2, tries=6)
    return before or room.standing_free(small, 0.2)


def _lamp(room: Furnisher, group: str) -> Piece | None:
    """Hang a lamp over the middle of the room, or between there and the bed."""
    kind = "pendant_lamp" if room.rng.random() < 0.76 else "ceiling_lamp"
    x, z = room.lamp_position()
    if room.rng.random() < 0.35:
        x, z = (x + room.anchor.x) / 2, (z + room.anchor.z) / 2
    lamp = room.hang(room.catalog[kind], (x, z), 1.65, LAMP_ANGLED)
    return lamp or room.hang(room.catalog["ceiling_lamp"], (x, z), 1.65, LAMP_ANGLED)


def _loose(room: Furnisher, group: str) -> Piece | None:
    angled = ANGLED if group == "chair" else 0.2
    return room.standing_free(room.models(group, below=0.8), angled)


BEDROOM = RoomType(
    name="bedroom",
    label_set="front3d_bedroom",
    counts=COUNTS,
    draw_first=lambda rng: str(rng.choice(list(BEDS), p=list(BEDS.values()))),
    draw_groups=_draw_groups,
    place_first=_place_bed,
    rules={
        "nightstands": lambda room, group: room.twins_beside(
            room.catalog["nightstand"], int(group[-1])
        ),
        "tv_stand": opposite_the_anchor,
        "wardrobe": along_wall(0.5),
        "children_cabinet": along_wall(0.5),
        "desk": table_and_seat(ANGLED),
        "dressing_table": table_and_seat(ANGLED),
        "sofa": _sofa,
        "bookshelf": along_wall(0.35),
        "cabinet": along_wall(0.35),
        "bench": _bench,
        "bedside": _bedside_lamps,
        "armchair": _armchair,
        "shelf": along_wall(0.35),
        "table": _loose,
        "chair": _loose,
        "lamp": _lamp,
    },
    area_m2=(7.5, 1.35),
    growing_tries=30,
    sides_m=(2.7, 6.0),
    l_shaped_chance=0.12,
    reach=(*BEDS, "wardrobe", "desk"),
)

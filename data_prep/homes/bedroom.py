"""Samples the furniture of a bedroom and the rules that place it."""

import numpy as np

from data_prep.homes.furnish import (
    Offers,
    RoomType,
    draw_basics,
    draw_extras,
    opposite_the_anchor,
    reading_corner,
    storage,
    table_and_seat,
)
from data_prep.homes.layout import Piece
from data_prep.homes.place import Furnisher

COUNTS = {2: 157, 3: 782, 4: 1731, 5: 2057, 6: 1296, 7: 821, 8: 419, 9: 234, 10: 112, 11: 58,
          12: 21, 13: 7}  # fmt: skip
"""Histogram of the number of pieces per room over the paper authors' 7,835 bedrooms.

Rooms with one piece or more than 13 pieces are left out here as well.
"""

BEDS = {"double_bed": 0.70, "single_bed": 0.18, "kids_bed": 0.12}

NIGHTSTANDS = {
    "double_bed": [0.80, 0.14, 0.06], "single_bed": [0.14, 0.61, 0.25], "kids_bed": [0, 0.6, 0.4],
}  # fmt: skip
"""Chances of two, one and no nightstands at each bed."""

LAMP_ANGLED = 0.3
"""Chance that a lamp is rotated off the axes."""

EXTRAS: Offers = {
    "tv_stand": (1, 0.34),
    "cabinet": (1, 0.30),
    "desk and chair": (2, 0.34),
    "dressing_table and dressing_chair": (2, 0.26),
    "armchair": (1, 0.10),
    "armchair and table": (2, 0.16),
    "bookshelf": (1, 0.16),
    "shelf": (1, 0.10),
    "stool": (1, 0.22),
    "sofa": (1, 0.04),
    "sofa and coffee_table": (2, 0.07),
    "children_cabinet": (1, 0.30),
    "bedside lamps": (2, 0.07),
}
"""Furniture of a bedroom besides bed, nightstands, wardrobe and lamp."""


def _draw_groups(rng: np.random.Generator, count: int, bed: str) -> list[str]:
    nightstands = int(rng.choice([2, 1, 0], p=NIGHTSTANDS[bed]))
    store = "children_cabinet" if bed == "kids_bed" and rng.random() < 0.5 else "wardrobe"
    basics = [("lamp", 1, 0.88), (f"nightstands {nightstands}", nightstands, 1.0), (store, 1, 0.82)]
    groups, left = draw_basics(rng, basics, count)
    offers = {name: offer for name, offer in EXTRAS.items() if name not in groups}
    if "nightstands 2" not in groups or bed != "double_bed":
        del offers["bedside lamps"]
    other = "dressing" if bed == "kids_bed" else "children"
    offers = {name: offer for name, offer in offers.items() if other not in name}
    fallback = {name: EXTRAS[name] for name in ("cabinet", "shelf", "bookshelf", "stool")}
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
    small = room.smallest("pendant_lamp", 4)
    twin = [small[room.rng.integers(len(small))]]
    return all([room.hang(twin, (n.x, n.z), n.top + 0.3, 0.0) for n in room.named("nightstand")])


def _sofa(room: Furnisher, group: str) -> Piece | None:
    sofa = room.against_wall(room.models("sofa", below=2.4), clearance=0.5)
    if sofa is None or not group.endswith("coffee_table"):
        return sofa
    return room.before(sofa, room.models("coffee_table", below=1.3), (0.25, 0.4))


def _stool(room: Furnisher, group: str) -> Piece | None:
    """Place a bench at the foot of the bed, or a stool at a wall."""
    long = room.models("stool", above=min(0.8, 0.5 * room.anchor.size_m[0]))
    at_foot = room.before(room.anchor, long, (0.03, 0.12), (-0.03, 0.03), tries=8)
    return at_foot or room.against_wall(room.models("stool", below=0.8), corner=0.8)


def _lamp(room: Furnisher, group: str) -> Piece | None:
    """Hang a lamp over the middle of the room, or between there and the bed."""
    kind = "pendant_lamp" if room.rng.random() < 0.76 else "ceiling_lamp"
    x, z = room.lamp_position()
    if room.rng.random() < 0.15:
        x, z = (x + room.anchor.x) / 2, (z + room.anchor.z) / 2
    lamp = room.hang(room.catalog[kind], (x, z), 1.8, LAMP_ANGLED)
    return lamp or room.hang(room.catalog["ceiling_lamp"], (x, z), 1.8, LAMP_ANGLED)


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
        "stool": _stool,
        "tv_stand": opposite_the_anchor,
        "wardrobe": storage(0.6),
        "children_cabinet": storage(0.6),
        "desk": table_and_seat,
        "dressing_table": table_and_seat,
        "sofa": _sofa,
        "bookshelf": storage(0.5),
        "cabinet": storage(0.6),
        "bedside": _bedside_lamps,
        "armchair": reading_corner,
        "shelf": storage(0.4),
        "lamp": _lamp,
    },
    area_m2=(7.5, 1.35),
    growing_tries=30,
    sides_m=(2.7, 6.0),
    l_shaped_chance=0.12,
    reach=(*BEDS, "wardrobe", "desk"),
)

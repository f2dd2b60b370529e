"""Samples the furniture of a living room and the rules that place it."""

from math import inf

import numpy as np
import shapely

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
from data_prep.homes.layout import Layout, Piece
from data_prep.homes.place import Furnisher
from sceneprior.furniture.catalog import Model

COUNTS = {4: 40, 5: 65, 6: 90, 7: 110, 8: 120, 9: 120, 10: 110, 11: 95, 12: 78, 13: 60, 14: 44,
          15: 32, 16: 23, 17: 16, 18: 11, 19: 8, 20: 5, 21: 3}  # fmt: skip
"""Weight per number of pieces in a room: mean 9.8, maximum ATISS's 21. The weights are our choice,
for lack of a real histogram."""

LAMP_ANGLED = 0.12
CHAIR_ANGLED = 0.12
SEAT_ANGLED = 0.33
"""Chances that a lamp, a dining chair, and an armchair are rotated off the axes."""

EXTRAS: Offers = {
    "armchair": (1, 0.12),
    "armchair and table": (2, 0.22),
    "side tables 1": (1, 0.3),
    "side tables 2": (2, 0.4),
    "stool": (1, 0.2),
    "cabinet": (1, 0.55),
    "bookshelf": (1, 0.35),
    "shelf": (1, 0.16),
    "wardrobe": (1, 0.03),
    "desk and chair": (2, 0.25),
    "lamp": (1, 0.2),
}
"""Furniture of a living room besides sofa, coffee table, TV stand and dining table."""

SEATS = {"seats 1": (1, 0.25), "seats 2": (2, 0.3), "sofa": (1, 0.25), "": (0, 0.2)}
"""Groups of seats around the coffee table, with their pieces and chances."""


def _draw_groups(rng: np.random.Generator, count: int, first: str) -> list[str]:
    chairs = int(rng.choice([2, 4, 6, 8], p=[0.15, 0.45, 0.3, 0.1]))
    chairs = min(chairs, (count - 3) // 2 * 2)
    seats = str(rng.choice(list(SEATS), p=[chance for _, chance in SEATS.values()]))
    basics = [("tv_stand", 1, 0.85), ("coffee_table", 1, 0.95), ("lamp", 1, 0.85)]
    basics.append((seats, SEATS[seats][0], 0.8))
    if chairs >= 2:
        basics.append((f"dining {chairs}", 1 + chairs, 0.85 if count > 5 else 0.45))
    groups, left = draw_basics(rng, basics, count)
    fallback = {
        name: EXTRAS[name] for name in ("cabinet", "bookshelf", "shelf", "lamp", "armchair")
    }
    return draw_extras(rng, groups, left, EXTRAS, fallback, ("cabinet", "bookshelf", "lamp"))


def _place_sofa(room: Furnisher, groups: list[str]) -> Piece | None:
    dining = any(group.startswith("dining") for group in groups)
    wall, share = room.long_wall(2 if dining else 4), room.rng.uniform(0.35, 0.65)
    if dining:  # leaves one end to the table
        share = float(room.rng.choice([0.0, 1.0]) + room.rng.uniform(-0.3, 0.3))
    where = wall.length_m * share
    return room.against_wall(room.catalog["sofa"], 0.5, [wall], where=where, tries=10)


def _coffee_table(room: Furnisher, group: str) -> Piece | None:
    fit = room.models("coffee_table", below=0.8 * room.anchor.size_m[0])
    low = [model for model in fit if model.size_m[1] < 0.6 and model.size_m[2] < 1.1]
    return room.before(room.anchor, low, (0.3, 0.45), angled=0.05)


def _dining(room: Furnisher, group: str) -> bool:
    """Place "dining 6", a table with six chairs, near the middle of the floor beside the lounge."""
    layout, rng = room.layout, room.rng
    count = int(group.split(" ")[1])
    above, below = (1.5, inf) if count > 4 else (1.0, 2.0)
    tables = room.models("table", below, above)
    chairs = room.smallest("chair", 5, "Dining")
    (x0, x1), (z0, z1) = _beside_lounge(room)
    lounge = shapely.union_all([shapely.box(*piece.rect) for piece in layout.pieces])
    for attempt in range(40):
        table, chair = room.pick(tables), room.pick(chairs)
        x, z = rng.normal(((x0 + x1) / 2, (z0 + z1) / 2), 0.02 * attempt)
        table = table.at(x, z, np.pi / 2 * (z1 - z0 > x1 - x0))
        places = _chair_places(table, chair.size_m[0], count)
        ring = [
            room.facing(table, chair, rng.uniform(0.02, 0.07), sideways, side, CHAIR_ANGLED)
            for side, sideways in places
        ]
        rects = shapely.union_all([shapely.box(*piece.rect) for piece in (table, *ring)])
        fits = all(layout.fits(piece) for piece in (table, *ring))
        if len(places) < count or not fits or rects.distance(lounge) < 0.4:
            continue
        trial = Layout(layout.width, layout.depth, layout.height, layout.notch, [table])
        if all([trial.add(piece) for piece in ring]):
            layout.pieces += [table, *ring]
            return True
    return False


def _beside_lounge(room: Furnisher) -> tuple[tuple[float, float], tuple[float, float]]:
    """Ranges of x and of z of the larger part of the floor beside the sofa and its group."""
    layout = room.layout
    rects = np.array([piece.rect for piece in layout.pieces])
    axis = int(abs(np.sin(room.anchor.yaw_rad)) > 0.5)  # the wall behind the sofa runs along it
    sides = (layout.width, layout.depth)
    low, high = rects[:, axis].min(), rects[:, axis + 2].max()
    part = (0.0, low) if low > sides[axis] - high else (high, sides[axis])
    return ((0.0, sides[0]), part) if axis else (part, (0.0, sides[1]))


def _chair_places(table: Piece, width: float, count: int) -> list[tuple[float, float]]:
    """Places (rotation, sideways) of up to `count` chairs: long sides in pairs, then the ends."""
    long = int((table.size_m[0] + 0.05) // (width + 0.12))
    row = max(1, min(long, count // 2 if count <= 4 else (count - 1) // 2))
    step = min(table.size_m[0] / row, width + 0.25)
    sides = [(turn, (k + 0.5 - row / 2) * step) for k in range(row) for turn in (0.0, np.pi)]
    ends = [(np.pi / 2, 0.0), (-np.pi / 2, 0.0)] if table.size_m[2] > 0.6 else []
    return (sides + ends)[:count]


def _side_tables(room: Furnisher, group: str) -> bool:
    return room.twins_beside(room.models("table", below=0.75), int(group[-1]))


def _seats(room: Furnisher, group: str) -> bool:
    """Place "seats 2", two alike armchairs that face the coffee table: opposite the sofa if no
    television stands there, else on the table's two sides; or "seats 1", one of them."""
    tables, count = room.named("coffee_table"), int(group[-1])
    if not tables:
        return False
    table, chair = tables[0], room.pick(room.models("armchair", below=1.0))
    apart = chair.size_m[0] / 2 + 0.12
    sides = [(float(side), 0.0) for side in room.rng.permutation([-1, 1]) * np.pi / 2]
    opposite = [(0.0, side * apart) for side in (-1, 1)]
    # The table's front is towards the sofa.
    places = sides if room.named("tv_stand") or count == 1 else [(np.pi, y) for _, y in opposite]
    for side, sideways in places:
        for _ in range(3):
            gap, askew = room.rng.uniform(0.25, 0.45), SEAT_ANGLED * (count == 1)
            seat = room.facing(table, chair, gap, sideways, side, askew)
            if room.layout.add(seat, crowding=True):
                count -= 1
                break
        if not count:
            return True
    return False


def _at_coffee_table(room: Furnisher, models: list[Model]) -> Piece | None:
    """Place a piece at a side of the coffee table, facing it."""
    for table in room.named("coffee_table"):
        for side in room.rng.permutation([-1, 1]) * np.pi / 2:
            if at := room.before(table, models, (0.2, 0.4), side=float(side), tries=5):
                return at
    return None


def _second_sofa(room: Furnisher, group: str) -> Piece | None:
    """Place a short second sofa at the coffee table, or at a wall across the first's."""
    sofas = [model for model in room.models("sofa", below=2.2) if model.size_m[2] < 1.2]
    return _at_coffee_table(room, sofas) or room.against_wall(sofas, 0.4, room.other_walls())


def _stool(room: Furnisher, group: str) -> Piece | None:
    small = room.models("stool", below=0.75)
    return _at_coffee_table(room, small) or room.against_wall(small, corner=0.9)


def _cabinet(room: Furnisher, group: str) -> Piece | None:
    """Place a sideboard at the wall behind a dining table, or a cabinet elsewhere."""
    dining = [piece for piece in room.named("table") if piece.size_m[0] > 0.95]
    for table in dining if not room.named("cabinet") else ():
        low = [model for model in room.catalog[group] if model.size_m[1] < 1.2]
        place = np.array([table.x, table.z])
        wall = min(room.other_walls(), key=lambda wall: wall.distance_m(place))
        where = float(wall.direction @ (place - wall.start_m))
        if at := room.against_wall(low, 0.6, [wall], where=where, tries=6):
            return at
    return storage(0.6)(room, group)


def _lamp(room: Furnisher, group: str) -> Piece | None:
    """Hang a lamp: first over the dining table, then over the coffee table, then mid-room."""
    layout, rng = room.layout, room.rng
    hanging = [piece for piece in layout.pieces if piece.y > 0]
    large = [piece for piece in room.named("table") if piece.size_m[0] > 0.95]
    tables = large + room.named("coffee_table")
    if len(hanging) < len(tables) and rng.random() < 0.8:
        table = tables[len(hanging)]
        pendants, above, lowest = room.catalog["pendant_lamp"], (table.x, table.z), table.top + 0.6
        if lamp := room.hang(pendants, above, lowest, LAMP_ANGLED, table.yaw_rad):
            return lamp
    x, z = room.lamp_position()
    if hanging:
        x, z = (
            x + rng.uniform(-0.25, 0.25) * layout.width,
            z + rng.uniform(-0.25, 0.25) * layout.depth,
        )
    kind = "ceiling_lamp" if rng.random() < 0.55 else "pendant_lamp"
    return room.hang(room.catalog[kind], (x, z), 1.7, LAMP_ANGLED)


LIVING_ROOM = RoomType(
    name="living room",
    label_set="front3d_living",
    counts=COUNTS,
    draw_first=lambda rng: "lounge",
    draw_groups=_draw_groups,
    place_first=_place_sofa,
    rules={
        "coffee_table": _coffee_table,
        "tv_stand": opposite_the_anchor,
        "seats": _seats,
        "sofa": _second_sofa,
        "dining": _dining,
        "side": _side_tables,
        "wardrobe": storage(0.6),
        "desk": table_and_seat,
        "cabinet": _cabinet,
        "bookshelf": storage(0.5),
        "armchair": reading_corner,
        "stool": _stool,
        "shelf": storage(0.4),
        "lamp": _lamp,
    },
    area_m2=(10.0, 1.9),
    growing_tries=40,
    sides_m=(3.2, 12.0),
    l_shaped_chance=0.15,
    reach=("sofa", "table", "cabinet"),
)

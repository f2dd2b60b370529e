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
from data_prep.homes.layout import Layout, Piece, grown
from data_prep.homes.place import Furnisher
from sceneprior.furniture.catalog import Model
from sceneprior.furniture.tables import DEEP_SOFA_M

COUNTS = {4: 40, 5: 65, 6: 90, 7: 110, 8: 120, 9: 120, 10: 110, 11: 95, 12: 78, 13: 60, 14: 44,
          15: 32, 16: 23, 17: 16, 18: 11, 19: 8, 20: 5, 21: 3}  # fmt: skip
"""Weight per number of pieces in a room: mean 9.8, maximum ATISS's 21. The weights are our choice,
for lack of a real histogram."""

CHAIR_ANGLED = 0.05
SEAT_ANGLED = 0.33
"""Chances that a dining chair and an armchair are rotated off the axes."""

BEFORE_SOFA_M = 1.2
"""Depth of the floor in front of the sofa for a coffee table and seats alone."""
PULLED_OUT_M = 0.4
"""Free floor around a dining chair."""
TABLES_M = {2: (0.75, 1.2), 4: (1.15, 2.0), 6: (1.5, 2.5), 8: (1.9, inf)}
"""Widths of a dining table with this number of chairs."""
LAMPS_APART_M = 1.5
"""Minimum distance between lamps that hang over no table."""

EXTRAS: Offers = {
    "armchair": (1, 0.12),
    "armchair and table": (2, 0.22),
    "side tables 1": (1, 0.3),
    "side tables 2": (2, 0.4),
    "stool": (1, 0.2),
    "cabinet": (1, 0.55),
    "bookshelf": (1, 0.35),
    "shelf": (1, 0.16),
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
    wall, share = room.long_wall(2), room.rng.uniform(0.35, 0.65)
    if dining:  # leaves one end to the table
        share = float(room.rng.choice([0.0, 1.0]) + room.rng.uniform(-0.3, 0.3))
    where = wall.length_m * share
    return room.against_wall(room.catalog["sofa"], BEFORE_SOFA_M, [wall], where=where, tries=10)


def _low(models: list[Model], below_m: float) -> list[Model]:
    return [model for model in models if model.size_m[1] < below_m]


def _coffee_table(room: Furnisher, group: str) -> Piece | None:
    """Place a coffee table in front of the sofa's middle, its long side to the sofa."""
    width, _, depth = room.anchor.size_m
    low = _low(room.models("coffee_table", below=0.8 * width), 0.6)
    along = [model for model in low if model.size_m[2] < min(1.1, 1.1 * model.size_m[0])]
    gap = (0.15, 0.25) if depth > DEEP_SOFA_M else (0.3, 0.4)
    return room.before(room.anchor, along, gap, sideways=(-0.04, 0.04))


def _tv_stand(room: Furnisher, group: str) -> Piece | None:
    """Place a low TV stand opposite the sofa, hardly wider than it; a small one if none is."""
    low = _low(room.models(group, below=room.anchor.size_m[0] + 0.3), 0.7)
    return opposite_the_anchor(room, group, low or room.smallest(group, 3))


def _dining(room: Furnisher, group: str) -> bool:
    """Place "dining 6", a table with six chairs, near the middle of the floor beside the lounge."""
    layout, rng = room.layout, room.rng
    count = int(group.split(" ")[1])
    above, below = TABLES_M[count]
    tables = _low(room.models("table", below, above), 1.0)
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
        free = [grown(chair.rect, PULLED_OUT_M) for chair in ring]
        fits = all(layout.fits(piece) for piece in (table, *ring))
        fits = fits and all(layout.holds(rect) for rect in free)
        if len(places) < count or not fits or rects.distance(lounge) < PULLED_OUT_M:
            continue
        trial = Layout(layout.width, layout.depth, layout.height, layout.notch, [table])
        if all([trial.add(piece) for piece in ring]):
            layout.pieces += [table, *ring]
            layout.kept_clear += free
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
    step = min(table.size_m[0] / row, width + 0.5)
    sides = [(turn, (k + 0.5 - row / 2) * step) for k in range(row) for turn in (0.0, np.pi)]
    ends = [(np.pi / 2, 0.0), (-np.pi / 2, 0.0)] if table.size_m[2] > 0.6 else []
    return (sides + ends)[:count]


def _side_tables(room: Furnisher, group: str) -> bool:
    return room.twins_beside(_low(room.models("table", below=0.75), 0.65), int(group[-1]))


def _seats(room: Furnisher, group: str) -> bool:
    """Place "seats 2", two alike armchairs that face the coffee table: opposite the sofa if no
    television stands there, else on the table's two sides; or "seats 1", one of them."""
    tables, count = room.named("coffee_table"), int(group[-1])
    if not tables:
        return False
    table, chair = tables[0], room.pick(room.models("armchair", below=1.0))
    if room.named("tv_stand") or count == 1:
        sides = [int(side) for side in room.rng.permutation([-1, 1])[:count]]
        return all(
            [_add_beside(room, table, chair, side, SEAT_ANGLED * (count == 1)) for side in sides]
        )
    apart, gap = chair.size_m[0] / 2 + 0.12, room.rng.uniform(0.25, 0.45)
    pair = [room.facing(table, chair, gap, side * apart, np.pi) for side in (-1, 1)]
    return all([room.layout.add(seat, crowding=True) for seat in pair])


def _add_beside(
    room: Furnisher, table: Piece, seat: Piece, side: int, angled: float = 0.0
) -> Piece | None:
    """Add a seat that faces a side of the coffee table, about beyond the end of the sofa (at most
    0.7 m from the table), and wholly in front of the sofa's front edge."""
    sofa, half_table_m = room.anchor, table.size_m[0] / 2
    ahead_m = float(np.hypot(table.x - sofa.x, table.z - sofa.z)) - sofa.size_m[2] / 2
    sideways = side * max(0.0, seat.size_m[0] / 2 + 0.1 - ahead_m)
    for _ in range(3):
        least = sofa.size_m[0] / 2 - 0.25 - half_table_m
        gap = max(room.rng.uniform(0.25, 0.45), min(least, 0.7))
        placed = room.facing(table, seat, gap, sideways, side * np.pi / 2, angled)
        if room.layout.add(placed, crowding=True):
            return placed
    return None


def _at_coffee_table(room: Furnisher, models: list[Model]) -> Piece | None:
    """Place a piece at a side of the coffee table, facing it."""
    for table in room.named("coffee_table"):
        for side in room.rng.permutation([-1, 1]):
            if at := _add_beside(room, table, room.pick(models), int(side)):
                return at
    return None


def _second_sofa(room: Furnisher, group: str) -> Piece | None:
    """Place a short second sofa at a side of the coffee table."""
    short = room.models("sofa", below=2.2)
    return _at_coffee_table(room, [model for model in short if model.size_m[2] < 1.2])


def _stool(room: Furnisher, group: str) -> Piece | None:
    return _at_coffee_table(room, room.models("stool", below=0.75))


def _armchair(room: Furnisher, group: str) -> Piece | None:
    """Place "armchair" at the coffee table if a side is free, else as `reading_corner` does."""
    alone = group == "armchair" and not room.named("armchair")
    at_table = _at_coffee_table(room, room.models("armchair", below=1.0)) if alone else None
    return at_table or reading_corner(room, group)


def _cabinet(room: Furnisher, group: str) -> Piece | None:
    """Place a sideboard at the wall behind a dining table, or a cabinet elsewhere."""
    dining = [piece for piece in room.named("table") if piece.size_m[0] > 0.95]
    for table in dining if not room.named("cabinet") else ():
        low = _low(room.models(group, above=0.7), 1.2)
        place = np.array([table.x, table.z])
        wall = min(room.other_walls(), key=lambda wall: wall.distance_m(place))
        where = float(wall.direction @ (place - wall.start_m))
        if at := room.against_wall(low, 0.6, [wall], where=where, tries=6):
            return at
    return storage(0.6, above=0.7)(room, group)


def _lamp(room: Furnisher, group: str) -> Piece | None:
    """Hang a lamp: over the dining table, then over the coffee table, then mid-room."""
    layout, rng, ceiling = room.layout, room.rng, room.catalog["ceiling_lamp"]
    hanging = [piece for piece in layout.pieces if piece.y > 0]

    def lit(x: float, z: float, within_m: float) -> bool:
        return any(np.hypot(lamp.x - x, lamp.z - z) < within_m for lamp in hanging)

    dining = [piece for piece in room.named("table") if piece.size_m[0] > 0.95]
    for table in dining + room.named("coffee_table"):
        if lit(table.x, table.z, 0.5):
            continue
        width, _, depth = table.size_m
        narrow = [m for m in room.models("pendant_lamp", below=width) if m.size_m[2] < depth]
        kind = ceiling if table not in dining and rng.random() < 0.4 else narrow
        above, lowest = (table.x, table.z), table.top + 0.6
        if lamp := room.hang(kind, above, lowest, 0.0, table.yaw_rad, spread=0.01):
            return lamp
    thirds = rng.permutation([(a, b) for a in (0.25, 0.5, 0.75) for b in (0.25, 0.5, 0.75)])
    for x, z in (room.lamp_position(), *(thirds * (layout.width, layout.depth)).tolist()):
        if not lit(x, z, LAMPS_APART_M):
            return room.hang(ceiling, (x, z), 1.7, 0.0)
    return None


LIVING_ROOM = RoomType(
    name="living room",
    label_set="front3d_living",
    counts=COUNTS,
    draw_first=lambda rng: "lounge",
    draw_groups=_draw_groups,
    place_first=_place_sofa,
    rules={
        "coffee_table": _coffee_table,
        "tv_stand": _tv_stand,
        "seats": _seats,
        "sofa": _second_sofa,
        "dining": _dining,
        "side": _side_tables,
        "desk": table_and_seat,
        "cabinet": _cabinet,
        "bookshelf": storage(0.5, above=0.6),
        "armchair": _armchair,
        "stool": _stool,
        "shelf": storage(0.4, above=0.55),
        "lamp": _lamp,
    },
    area_m2=(8.5, 1.8),
    growing_tries=40,
    sides_m=(3.2, 12.0),
    l_shaped_chance=0.15,
    reach=("sofa", "table", "cabinet"),
)

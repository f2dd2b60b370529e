"""Samples the furniture of a living room and the rules that place it."""

from dataclasses import replace

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
from data_prep.homes.layout import Layout, Piece, yaw_at

COUNTS = {4: 40, 5: 65, 6: 90, 7: 110, 8: 120, 9: 120, 10: 110, 11: 95, 12: 78, 13: 60, 14: 44,
          15: 32, 16: 23, 17: 16, 18: 11, 19: 8, 20: 5, 21: 3}  # fmt: skip
"""Weight per number of pieces in a room: mean 9.8, maximum ATISS's 21. The weights are our choice,
for lack of a real histogram."""

SEAT_ANGLED = 0.55
LAMP_ANGLED = 0.12
CHAIR_ANGLED = 0.12
"""Chances that a seat, a lamp, and a dining chair are rotated off the axes."""

EXTRAS: Offers = {
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
"""Furniture of a living room besides sofa, coffee table, TV stand and dining table."""


def _draw_groups(rng: np.random.Generator, count: int, first: str) -> list[str]:
    chairs = min(int(rng.choice([2, 4, 6, 8], p=[0.15, 0.45, 0.3, 0.1])), count - 3)
    basics = [("tv_stand", 1, 0.85), ("coffee_table", 1, 0.9), ("lamp", 1, 0.85)]
    if chairs >= 2:
        basics.append((f"dining {chairs}", 1 + chairs, 0.85 if count > 5 else 0.45))
    groups, left = draw_basics(rng, basics, count)
    fallback = {name: EXTRAS[name] for name in ("armchair", "cabinet", "shelf", "lamp", "stool")}
    return draw_extras(rng, groups, left, EXTRAS, fallback, ("armchair", "cabinet", "lamp"))


def _place_sofa(room: Furnisher, groups: list[str]) -> Piece | None:
    wall, share = room.long_wall(), room.rng.uniform(0.35, 0.65)
    if any(group.startswith("dining") for group in groups):  # leaves one end to the table
        share = float(room.rng.choice([0.0, 1.0]) + room.rng.uniform(-0.3, 0.3))
    where = wall.length_m * share
    return room.against_wall(room.catalog["sofa"], 0.5, [wall], where=where, tries=10)


def _coffee_table(room: Furnisher, group: str) -> Piece | None:
    tables = room.models("coffee_table", below=0.8 * room.anchor.size_m[0])
    return room.before(room.anchor, tables, (0.3, 0.45), angled=0.05)


def _dining(room: Furnisher, group: str) -> bool:
    """Place "dining 6", a table with six chairs, preferably not in front of the sofa."""
    layout, rng = room.layout, room.rng
    count = int(group.split(" ")[1])
    tables = room.models("table", above=1.5 if count > 4 else 1.0)
    chairs = [model for model in room.models("chair", below=0.68) if model.size_m[2] < 0.72]
    for attempt in range(40):
        table, chair = room.pick(tables), room.pick(chairs)
        yaw = float(rng.integers(4)) * np.pi / 2
        half_x, half_z = table.half_extent(yaw)
        around = chair.model.size_m[2] + 0.1
        if 2 * (half_x + around) > layout.width or 2 * (half_z + around) > layout.depth:
            continue
        x = rng.uniform(half_x + around, layout.width - half_x - around)
        z = rng.uniform(half_z + around, layout.depth - half_z - around)
        table = table.at(x, z, yaw)
        if attempt < 30 and _is_before(room.anchor, table):
            continue
        places = _chair_places(table, chair.size_m[0], count)
        if len(places) < count or not layout.fits(table):
            continue
        ring = [_chair_at(room, table, chair, *place) for place in places]
        if not all(layout.fits(piece) for piece in ring):
            continue
        trial = Layout(layout.width, layout.depth, layout.height, layout.notch, [table])
        if all([trial.add(piece) for piece in ring]):
            layout.pieces += [table, *ring]
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


def _side_tables(room: Furnisher, group: str) -> object:
    small = room.models("table", below=0.75)
    count = int(group[-1])
    return room.twins_beside(small, count) or (count == 1 and room.standing_free(small, 0.1))


def _armchair(room: Furnisher, group: str) -> Piece | None:
    """Place an armchair at a side of the coffee table, facing it, or near a wall."""
    tables = [piece for piece in room.layout.pieces if piece.model.name == "coffee_table"]
    chairs, sofa = room.catalog["armchair"], room.anchor
    for side in room.rng.permutation([-1, 1]) if tables else ():
        table = tables[0]
        yaw = sofa.yaw_rad + side * np.pi / 2
        anchor = replace(table, yaw_rad=yaw, scale=(1.0, 1.0, 1.0))
        gap = table.half_extent(table.yaw_rad - yaw)[1] - anchor.size_m[2] / 2
        gaps = (gap + 0.25, gap + 0.5)
        if at := room.before(anchor, chairs, gaps, (-0.3, 0.3), angled=SEAT_ANGLED, tries=6):
            return at
    return room.standing_free(chairs, SEAT_ANGLED, (sofa.x, sofa.z))


def _second_sofa(room: Furnisher, group: str) -> Piece | None:
    """Place a short second sofa at a wall perpendicular to the first's."""
    yaw = room.anchor.yaw_rad
    across = [wall for wall in room.layout.walls if abs(np.cos(yaw_at(wall) - yaw)) < 0.5]
    return room.against_wall(room.models("sofa", below=2.2), 0.4, across)


def _lamp(room: Furnisher, group: str) -> Piece | None:
    """Hang a lamp: first over the dining table, then over the coffee table, then mid-room."""
    layout, rng = room.layout, room.rng
    hanging = [piece for piece in layout.pieces if piece.y > 0]
    large = [p for p in layout.pieces if p.model.name == "table" and p.size_m[0] > 0.95]
    tables = large + [piece for piece in layout.pieces if piece.model.name == "coffee_table"]
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


def _loose(room: Furnisher, group: str) -> Piece | None:
    sofa = (room.anchor.x, room.anchor.z)
    return room.standing_free(room.models(group, below=0.9), SEAT_ANGLED, sofa)


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
        "dining": _dining,
        "side": _side_tables,
        "sofa": _second_sofa,
        "armchair": _armchair,
        "wardrobe": along_wall(0.4),
        "desk": table_and_seat(SEAT_ANGLED),
        "bookshelf": along_wall(0.4),
        "cabinet": along_wall(0.4),
        "stool": _loose,
        "shelf": along_wall(0.4),
        "chair": _loose,
        "lamp": _lamp,
    },
    area_m2=(10.0, 1.9),
    growing_tries=40,
    sides_m=(3.2, 12.0),
    l_shaped_chance=0.15,
    reach=("sofa", "table", "cabinet"),
)

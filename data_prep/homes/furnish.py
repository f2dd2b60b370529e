"""Furnishes a room: samples its furniture and an empty room, and retries until all pieces fit."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from data_prep.homes.layout import Layout, Piece, empty_room, is_liveable, yaw_at
from data_prep.homes.place import Furnisher
from sceneprior.furniture.catalog import STYLES, Catalog, Model

Offers = dict[str, tuple[int, float]]
"""Number of pieces and sampling weight per group of pieces, such as "desk and chair"."""


STORAGE = (
    "wardrobe", "children_cabinet", "cabinet", "bookshelf", "shelf", "desk", "tv_stand",
)  # fmt: skip
"""Classes beside which storage stands in a row."""
IN_ROW, AT_WINDOW = 0.5, 0.7
"""Chances that storage stands in a row, and a desk under a window, if there is space."""
ASKEW = 0.3
"""Chance that a chair at a table is rotated."""

Rule = Callable[[Furnisher, str], object]
"""Places the pieces of a group; returns None or False if one of them does not fit."""


@dataclass(frozen=True)
class RoomType:
    """Procedure that furnishes rooms of one type.

    A group is a set of pieces that are sampled and placed together; the first word of its name
    selects the rule that places it.
    """

    name: str
    label_set: str
    counts: dict[int, int]
    """Sampling weight per number of pieces in a room."""
    draw_first: Callable[[np.random.Generator], str]
    """Samples the group that is placed first; it has one piece."""
    draw_groups: Callable[[np.random.Generator, int, str], list[str]]
    """Samples the other groups, given their total number of pieces and the first group."""
    place_first: Callable[[Furnisher, list[str]], Piece | None]
    """Places the first group, given all groups."""
    rules: dict[str, Rule]
    """Rules by the first word of a group's name, in the order of placement."""
    area_m2: tuple[float, float]
    """Floor area: base, and increment per piece."""
    growing_tries: int
    """Number of failed tries after each of which the room grows by 2% of its initial area."""
    sides_m: tuple[float, float]
    """Shortest and longest side of a room."""
    l_shaped_chance: float
    reach: tuple[str, ...]
    """Classes that must be reachable on foot from the door."""


def furnish(
    room_type: RoomType, catalog: Catalog, rng: np.random.Generator, share: float
) -> Layout:
    """Make a furnished, walkable room; `share` is the quantile of its number of pieces."""
    total = np.cumsum(list(room_type.counts.values()))
    at = int(np.searchsorted(total, share * total[-1], side="right"))
    count = list(room_type.counts)[at]
    first = room_type.draw_first(rng)
    style = str(rng.choice(STYLES))
    order = list(room_type.rules)
    base, per_piece = room_type.area_m2
    for attempt in range(400):
        if attempt % 8 == 0:
            groups = room_type.draw_groups(rng, count - 1, first)
            groups.sort(key=lambda group: order.index(group.split(" ")[0]))
            groups.insert(0, first)
        growth = 1 + 0.02 * min(attempt, room_type.growing_tries)
        area = (base + per_piece * count) * rng.uniform(0.85, 1.2) * growth
        layout = empty_room(rng, area, room_type.sides_m, room_type.l_shaped_chance)
        room = Furnisher(layout, catalog, rng, style)
        anchor = room_type.place_first(room, groups)
        if anchor is None:
            continue
        room.anchor = anchor
        arranged = all(room_type.rules[group.split(" ")[0]](room, group) for group in groups[1:])
        if arranged and is_liveable(layout, room_type.reach):
            return layout
    raise RuntimeError(
        f"No {room_type.name} could hold these {count} pieces in 400 tries: {groups}."
    )


def draw_basics(
    rng: np.random.Generator, basics: list[tuple[str, int, float]], left: int
) -> tuple[list[str], int]:
    """Sample groups from `basics`, (name, pieces, chance), with at most `left` pieces in total.

    Returns the sampled groups and the number of pieces that remain for other groups.
    """
    groups = []
    for name, pieces, chance in [basics[k] for k in rng.permutation(len(basics))]:
        if 0 < pieces <= left and rng.random() < chance:
            groups.append(name)
            left -= pieces
    return groups, left


def draw_extras(
    rng: np.random.Generator,
    groups: list[str],
    left: int,
    offers: Offers,
    fallback: Offers,
    twice: tuple[str, ...] = (),
) -> list[str]:
    """Extend the groups with samples from `offers` until no pieces are left.

    Groups with the same first word are sampled once (one desk is enough), those of `twice` up to
    twice. When no offer fits any more, `fallback` replaces the offers.
    """
    groups = list(groups)
    while left:
        fitting = [name for name, (pieces, _) in offers.items() if pieces <= left]
        if not fitting:
            offers = fallback
            continue
        weights = np.array([offers[name][1] for name in fitting])
        chosen = str(rng.choice(fitting, p=weights / weights.sum()))
        groups.append(chosen)
        left -= offers[chosen][0]
        if chosen not in twice or groups.count(chosen) >= 2:
            first = chosen.split(" ")[0]
            offers = {name: offer for name, offer in offers.items() if name.split(" ")[0] != first}
    return groups


def storage(clearance: float, above: float = 0.0) -> Callable[[Furnisher, str], Piece | None]:
    """Make a rule that places one piece of the class named by the group, wider than `above`, its
    back to a wall: often in a row with other storage, rarely at the wall of the anchor."""

    def place(room: Furnisher, group: str) -> Piece | None:
        models = room.models(group, above=above)
        for piece in room.named(*STORAGE) if room.rng.random() < IN_ROW else ():
            for side in (-1, 1):
                if placed := room.beside(piece, room.pick(models), side, clearance):
                    return placed
        walls = room.other_walls()
        at = room.against_wall(models, clearance, walls, corner=0.75, tries=25)
        return at or room.against_wall(models, clearance)

    return place


def table_and_seat(room: Furnisher, group: str) -> Piece | None:
    """Place "desk and chair": a desk under a window or along a wall, then a chair that faces it."""
    first, _, seat = group.partition(" and ")
    table, models = None, room.catalog[first]
    for window in room.layout.windows if room.rng.random() < AT_WINDOW else ():
        low = [model for model in models if 1.06 * model.size_m[1] < window.sill]
        if low and table is None:
            walls, where = [window.wall], window.middle
            table = room.against_wall(low, 1.05, walls, where=where, tries=6)
    table = table or room.against_wall(models, 1.05, corner=0.6)
    seats = room.smallest(seat, 3, "Office" if seat == "chair" else "")
    return table and room.before(table, seats, (0.01, 0.07), angled=ASKEW)


def reading_corner(room: Furnisher, group: str) -> Piece | None:
    """Place "armchair", or "armchair and table" with a small table beside it, in a corner."""
    seat, _, companion = group.partition(" and ")
    chair = room.in_corner(room.catalog[seat])
    if chair is None or not companion:
        return chair
    small = room.pick(room.models(companion, below=0.7))
    return next(filter(None, (room.beside(chair, small, side) for side in (-1, 1))), None)


def opposite_the_anchor(
    room: Furnisher, group: str, models: list[Model] | None = None
) -> Piece | None:
    """Place a piece of the class named by the group, or one of `models`, at the wall that the bed
    or the sofa faces."""
    anchor = room.anchor
    facing = [
        wall
        for wall in room.layout.walls
        if np.cos(yaw_at(wall) - anchor.yaw_rad) < -0.9 and wall.length_m > 1.5
    ]
    if not facing:
        return None
    wall = max(facing, key=lambda wall: wall.length_m)
    where = float(np.abs(wall.direction) @ np.abs((anchor.x, anchor.z) - wall.start_m))
    return room.against_wall(models or room.catalog[group], 0.6, [wall], where=where, tries=15)

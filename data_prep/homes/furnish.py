"""Furnishes a room: samples its furniture and an empty room, and retries until all pieces fit."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from data_prep.homes.layout import Layout, Piece, empty_room, is_liveable, yaw_at
from data_prep.homes.placement import Furnisher
from sceneprior.furniture.catalog import Catalog

Offers = dict[str, tuple[int, float]]
"""Number of pieces and sampling weight per group of pieces, such as "desk and chair"."""

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
    count = count_at(room_type.counts, share)
    first = room_type.draw_first(rng)
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
        room = Furnisher(layout, catalog, rng)
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


def count_at(histogram: dict[int, int], share: float) -> int:
    """Number of pieces at the quantile `share`, in [0, 1), of a histogram."""
    total = np.cumsum(list(histogram.values()))
    return list(histogram)[int(np.searchsorted(total, share * total[-1], side="right"))]


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


def along_wall(clearance: float) -> Rule:
    """Make a rule that places one piece of the class named by the group, its back to a wall."""
    return lambda room, group: room.against_wall(room.catalog[group], clearance)


def table_and_seat(angled: float) -> Rule:
    """Make a rule that places "desk and chair": a desk along a wall, then a chair that faces it.

    `angled` is the chance of a rotated chair.
    """

    def place(room: Furnisher, group: str) -> Piece | None:
        first, _, seat = group.partition(" and ")
        table = room.against_wall(room.catalog[first], clearance=0.75 if seat else 0.5)
        if table is None or not seat:
            return table
        return room.before(table, room.models(seat, below=0.75), (0.02, 0.12), angled=angled)

    return place


def opposite_the_anchor(room: Furnisher, group: str) -> Piece | None:
    """Place a piece of the class named by the group at the wall that the bed or the sofa faces."""
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
    return room.against_wall(room.catalog[group], walls=[wall], where=where, tries=15)

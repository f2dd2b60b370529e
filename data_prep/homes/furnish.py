"""Furnishes a room: draws what stands in it, then an empty room, and places all until it works."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from data_prep.homes.catalog import Catalog
from data_prep.homes.layout import Piece, Plan
from data_prep.homes.placement import Furnisher
from data_prep.homes.rooms import empty_room, is_liveable

Offers = dict[str, tuple[int, float]]
"""Group of pieces, such as "desk and chair" -> how many pieces it has, its weight in the draw."""

Rule = Callable[[Furnisher, str], bool]
"""Places the pieces of a group; False where one of them finds no place."""


@dataclass(frozen=True)
class RoomType:
    """How rooms of one type are furnished.

    A group is what is drawn and placed together; the first word of its name says by which rule.
    """

    name: str
    label_set: str
    counts: dict[int, int]
    """Pieces in a room -> weight."""
    draw_first: Callable[[np.random.Generator], str]
    """Draws the group that is placed first, of one piece."""
    draw_groups: Callable[[np.random.Generator, int, str], list[str]]
    """Draws the other groups for a number of pieces; given are that number and the first group."""
    place_first: Callable[[Furnisher, list[str]], Piece | None]
    """Places the first of all groups."""
    rules: dict[str, Rule]
    """First word of a group -> its rule, in the order of placing."""
    area_m2: tuple[float, float]
    """Floor area of a room without pieces, and for each piece more."""
    growing_tries: int
    """For so many failed tries the room grows by 2 % of its area."""
    sides_m: tuple[float, float]
    """The shortest and the longest side of a room."""
    l_shaped_chance: float
    reach: tuple[str, ...]
    """Classes that one must be able to walk to from the door."""


def furnish(room_type: RoomType, catalog: Catalog, rng: np.random.Generator, share: float) -> Plan:
    """A furnished room in which one can walk; this share of all rooms has fewer pieces."""
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
        plan = empty_room(rng, area, room_type.sides_m, room_type.l_shaped_chance)
        arranged = _arrange(room_type, Furnisher(plan, catalog, rng), groups)
        if arranged and is_liveable(plan, room_type.reach):
            return plan
    raise RuntimeError(
        f"No {room_type.name} with {count} pieces found room in 400 tries: {groups}."
    )


def count_at(histogram: dict[int, int], share: float) -> int:
    """The number of pieces below which this share in [0, 1) of the histogram lies."""
    total = np.cumsum(list(histogram.values()))
    return list(histogram)[int(np.searchsorted(total, share * total[-1], side="right"))]


def _arrange(room_type: RoomType, furnisher: Furnisher, groups: list[str]) -> bool:
    anchor = room_type.place_first(furnisher, groups)
    if anchor is None:
        return False
    furnisher.anchor = anchor
    return all(room_type.rules[group.split(" ")[0]](furnisher, group) for group in groups[1:])


def draw_basics(
    rng: np.random.Generator, basics: list[tuple[str, int, float]], left: int
) -> tuple[list[str], int]:
    """Groups out of (name, pieces, chance), in random order, and the pieces still left."""
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
    """The groups and more of those on offer until no pieces are left.

    A first word is drawn once (one desk, one sofa is enough) but for the groups of `twice`.
    Where nothing on offer fits any more, `fallback` is on offer.
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
    """A rule: one piece of the class that the group is named after, its back to a wall."""

    def place(furnisher: Furnisher, group: str) -> bool:
        return furnisher.against_wall(furnisher.catalog[group], clearance) is not None

    return place


def table_and_seat(angled: float) -> Rule:
    """A rule for "desk and chair" and the like; `angled` is the chance that the seat is askew."""
    return lambda furnisher, group: furnisher.pair_along_wall(group, angled)


def opposite_the_anchor(furnisher: Furnisher, group: str) -> bool:
    """A rule: one piece of the class that the group is named after, facing the bed or the sofa."""
    return furnisher.opposite(furnisher.anchor, furnisher.catalog[group]) is not None

"""Furnishes a room: samples its furniture and an empty room, and retries until all pieces fit.

A `Furnisher` places single pieces: against a wall, in front of or beside another piece, free, or
hanging.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf

import numpy as np

from data_prep.homes.layout import Layout, Piece, empty_room, is_liveable, point_by, yaw_at
from sceneprior.core.shell import Wall
from sceneprior.furniture.catalog import Catalog, Model

Offers = dict[str, tuple[int, float]]
"""Number of pieces and sampling weight per group of pieces, such as "desk and chair"."""


@dataclass
class Furnisher:
    """Places furniture from a catalogue in one layout.

    Each placing method tries several models, scales and positions, and returns the piece that it
    added to the layout, or None.
    """

    layout: Layout
    catalog: Catalog
    rng: np.random.Generator
    anchor: Piece = field(init=False)
    """Piece that the others are arranged around: the bed, or the sofa."""

    def models(self, name: str, below: float = inf, above: float = 0.0) -> list[Model]:
        """Models of a class whose width in metres lies between `above` and `below`."""
        return [model for model in self.catalog[name] if above < model.size_m[0] < below]

    def pick(self, models: list[Model]) -> Piece:
        """Sample one of the models without a place, and a scale within a few percent of 1 per axis,
        so that copies of a model differ."""
        model = models[self.rng.integers(len(models))]
        x, y, z = np.clip(self.rng.normal(1.0, 0.035, 3), 0.92, 1.08).round(4).tolist()
        return Piece(model, (x, y, z))

    def random_turn(self, chance: float) -> float:
        """Sample a rotation in radians: with this chance by 10 to 40 degrees, else 0."""
        if self.rng.random() >= chance:
            return 0.0
        return float(np.radians(self.rng.uniform(10, 40)) * self.rng.choice([-1, 1]))

    def long_wall(self) -> Wall:
        """Sample one of the four longest walls."""
        walls = sorted(self.layout.walls, key=lambda wall: -wall.length_m)[:4]
        return walls[self.rng.integers(len(walls))]

    def _try(
        self,
        models: list[Model],
        tries: int,
        propose: Callable[[Piece], Piece | None],
        clearance: float = 0.0,
        crowding: bool = False,
    ) -> Piece | None:
        for _ in range(tries):
            piece = propose(self.pick(models))
            if piece and self.layout.add(piece, clearance, crowding):
                return piece
        return None

    def against_wall(
        self,
        models: list[Model],
        clearance: float = 0.0,
        walls: list[Wall] | None = None,
        corner: float = 0.45,
        tries: int = 40,
        where: float | None = None,
    ) -> Piece | None:
        """Place a piece with its back to one of `walls` (None: all walls).

        `clearance` metres in front of the piece stay clear. `corner` is the chance to try an end of
        the wall. `where` is the desired position of the piece's centre along the wall in metres;
        the sampled position varies with a standard deviation of 0.15.
        """
        choice = self.layout.walls if walls is None else walls
        lengths = np.array([wall.length_m for wall in choice])

        def propose(piece: Piece) -> Piece | None:
            wall = choice[self.rng.choice(len(choice), p=lengths / lengths.sum())]
            width, _, depth = piece.size_m
            slack = wall.length_m - width
            if slack < 0.04:
                return None
            start = self.rng.uniform(0.01, slack - 0.01)
            if where is not None:
                start = np.clip(where - width / 2 + self.rng.normal(0, 0.15), 0.01, slack - 0.01)
            elif self.rng.random() < corner:
                start = self.rng.choice([0.02, slack - 0.02])
            off = depth / 2 + self.rng.uniform(0.006, 0.025)
            return piece.at(*point_by(wall, start + width / 2, off), yaw_at(wall))

        return self._try(models, tries, propose, clearance)

    def before(
        self,
        anchor: Piece,
        models: list[Model],
        gap: tuple[float, float],
        sideways: tuple[float, float] = (-0.1, 0.1),
        angled: float = 0.0,
        tries: int = 15,
    ) -> Piece | None:
        """Place a piece `gap` metres in front of another, facing it.

        `angled` is the chance of a random rotation.
        """

        def propose(piece: Piece) -> Piece:
            yaw = anchor.yaw_rad + np.pi + self.random_turn(angled)
            reach = piece.half_extent(yaw - anchor.yaw_rad)[1]
            off = anchor.size_m[2] / 2 + self.rng.uniform(*gap) + reach
            return piece.at(*anchor.ahead(off, self.rng.uniform(*sideways)), yaw)

        return self._try(models, tries, propose, crowding=True)

    def beside(self, anchor: Piece, piece: Piece, side: int) -> Piece | None:
        """Place the piece beside the anchor (side +1: the anchor's +x), with aligned backs."""
        width, _, depth = piece.size_m
        for _ in range(4):
            off = anchor.size_m[0] / 2 + width / 2 + self.rng.uniform(0.02, 0.12)
            place = anchor.ahead((depth - anchor.size_m[2]) / 2, side * off)
            placed = piece.at(*place, anchor.yaw_rad)
            if self.layout.add(placed, crowding=True):
                return placed
        return None

    def twins_beside(self, models: list[Model], count: int) -> bool:
        """Place two copies of a piece on both sides of the anchor, or one if `count` is 1."""
        piece = self.pick(models)
        sides = [int(side) for side in self.rng.permutation([-1, 1])]
        if count == 2:
            return all([self.beside(self.anchor, piece, side) for side in sides])
        return any(self.beside(self.anchor, piece, side) for side in sides)

    def standing_free(
        self, models: list[Model], angled: float, towards: tuple[float, float] | None = None
    ) -> Piece | None:
        """Place a light piece near a wall, facing a point or along one of the room's axes."""

        def propose(piece: Piece) -> Piece:
            width, depth = self.layout.width, self.layout.depth
            half = max(piece.model.size_m[0], piece.model.size_m[2]) / 2
            along = self.rng.uniform(half, width - half), self.rng.uniform(half, depth - half)
            edge = self.rng.integers(4)
            near = half + self.rng.uniform(0.06, 0.35)
            x = (near, width - near, along[0], along[0])[edge]
            z = (along[1], along[1], near, depth - near)[edge]
            yaw = float(self.rng.integers(4)) * np.pi / 2
            if towards is not None:
                exact = np.arctan2(towards[0] - x, towards[1] - z)
                yaw = float(np.round(exact / (np.pi / 2)) * np.pi / 2)
            return piece.at(x, z, yaw + self.random_turn(angled))

        return self._try(models, 40, propose)

    def hang(
        self,
        models: list[Model],
        place: tuple[float, float],
        lowest: float,
        angled: float,
        yaw_rad: float = 0.0,
    ) -> Piece | None:
        """Hang a lamp from the ceiling above `place`, no part of it below `lowest`."""

        def propose(piece: Piece) -> Piece | None:
            bottom = self.layout.height - piece.size_m[1]
            if bottom < lowest:
                return None
            yaw = yaw_rad + self.random_turn(angled)
            x, z = place[0] + self.rng.normal(0, 0.05), place[1] + self.rng.normal(0, 0.05)
            return piece.at(x, z, yaw, bottom)

        return self._try(models, 20, propose)

    def lamp_position(self) -> tuple[float, float]:
        """Centre of the largest rectangle of the floor."""
        width, depth = self.layout.width, self.layout.depth
        range_x, range_z = self.layout.beside_notch
        if (range_x[1] - range_x[0]) * depth > (range_z[1] - range_z[0]) * width:
            return sum(range_x) / 2, depth / 2
        return width / 2, sum(range_z) / 2


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

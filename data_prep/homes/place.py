"""Places single pieces of furniture in a room: against a wall, in front of or beside another piece,
in a corner, or hanging."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf

import numpy as np

from data_prep.homes.layout import Layout, Piece, point_by, yaw_at
from sceneprior.core.shell import Wall
from sceneprior.furniture.catalog import Catalog, Model

STYLED = 0.85
"""Chance that a piece is chosen among the models of the room's style."""
TURNED = 0.7
"""Chance that a seat in a corner is turned."""


@dataclass
class Furnisher:
    """Places furniture from a catalogue in one layout.

    Each placing method tries several models, scales and positions, and returns the piece that it
    added to the layout, or None.
    """

    layout: Layout
    catalog: Catalog
    rng: np.random.Generator
    style: str
    """Style that most of the room's furniture has."""
    anchor: Piece = field(init=False)
    """Piece that the others are arranged around: the bed, or the sofa."""

    def models(self, name: str, below: float = inf, above: float = 0.0) -> list[Model]:
        """Models of a class whose width in metres lies between `above` and `below`."""
        return [model for model in self.catalog[name] if above < model.size_m[0] < below]

    def smallest(self, name: str, count: int, category: str = "") -> list[Model]:
        """Models of a class, and perhaps of a category, that take the least floor."""
        models = [model for model in self.catalog[name] if category in model.category]
        return sorted(models, key=lambda model: model.size_m[0] * model.size_m[2])[:count]

    def pick(self, models: list[Model]) -> Piece:
        """Sample one of the models, mostly of the room's style, without a place, and a scale within
        a few percent of 1 per axis, so that copies of a model differ."""
        alike = [model for model in models if model.style_name == self.style]
        if alike and self.rng.random() < STYLED:
            models = alike
        model = models[self.rng.integers(len(models))]
        noise = np.clip(self.rng.normal(0, (0.03, 0.035, 0.015)), -0.06, 0.06)
        x, y, z = (1 + noise + (0, 0, noise[0])).round(4).tolist()
        return Piece(model, (x, y, z))

    def named(self, *names: str) -> list[Piece]:
        """Pieces of these classes, in the order in which they were placed."""
        return [piece for piece in self.layout.pieces if piece.model.name in names]

    def random_turn(self, chance: float) -> float:
        """Sample a rotation in radians: with this chance by 10 to 25 degrees, else 0."""
        if self.rng.random() >= chance:
            return 0.0
        return float(np.radians(self.rng.uniform(10, 25)) * self.rng.choice([-1, 1]))

    def long_wall(self, among: int = 4) -> Wall:
        """Sample one of the longest walls."""
        walls = sorted(self.layout.walls, key=lambda wall: -wall.length_m)[:among]
        return walls[self.rng.integers(len(walls))]

    def other_walls(self) -> list[Wall]:
        """Walls other than those that the anchor's back could stand at."""
        yaw = self.anchor.yaw_rad
        return [wall for wall in self.layout.walls if np.cos(yaw_at(wall) - yaw) < 0.9]

    def _try(
        self,
        models: list[Model],
        tries: int,
        propose: Callable[[Piece], Piece | None],
        clearance: float = 0.0,
        crowding: bool = False,
    ) -> Piece | None:
        for _ in range(tries if models else 0):
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

    def facing(
        self,
        anchor: Piece,
        piece: Piece,
        gap: float,
        sideways: float = 0.0,
        side: float = 0.0,
        angled: float = 0.0,
    ) -> Piece:
        """The piece `gap` metres in front of another, facing it; `side` is the angle from the
        anchor's front to another of its sides, and `angled` the chance of a random rotation."""
        turn = self.random_turn(angled)
        off = anchor.half_extent(side)[1] + gap + piece.half_extent(turn)[1]
        towards = replace(anchor, yaw_rad=anchor.yaw_rad + side)
        return piece.at(*towards.ahead(off, sideways), towards.yaw_rad + np.pi + turn)

    def before(
        self,
        anchor: Piece,
        models: list[Model],
        gap: tuple[float, float],
        sideways: tuple[float, float] = (-0.1, 0.1),
        side: float = 0.0,
        angled: float = 0.0,
        tries: int = 15,
    ) -> Piece | None:
        """Place a piece as `facing` says, with a gap and an offset within these ranges."""

        def propose(piece: Piece) -> Piece:
            gap_m, sideways_m = self.rng.uniform(*gap), self.rng.uniform(*sideways)
            return self.facing(anchor, piece, gap_m, sideways_m, side, angled)

        return self._try(models, tries, propose, crowding=True)

    def beside(
        self, anchor: Piece, piece: Piece, side: int, clearance: float | None = None
    ) -> Piece | None:
        """Place the piece beside the anchor (side +1: the anchor's +x), with aligned backs.

        With a clearance, it also needs free floor in front of it, as `against_wall` describes.
        """
        width, _, depth = piece.size_m
        straight = float(np.round(anchor.yaw_rad / (np.pi / 2)) * np.pi / 2)
        half_x, half_z = anchor.half_extent(anchor.yaw_rad - straight)
        upright = anchor.at(anchor.x, anchor.z, straight)
        for _ in range(4):
            off = half_x + width / 2 + self.rng.uniform(0.02, 0.1)
            placed = piece.at(*upright.ahead(depth / 2 - half_z, side * off), straight)
            if self.layout.add(placed, clearance or 0.0, crowding=clearance is None):
                return placed
        return None

    def twins_beside(self, models: list[Model], count: int) -> bool:
        """Place two copies of a piece on both sides of the anchor, or one if `count` is 1."""
        piece = self.pick(models)
        sides = [int(side) for side in self.rng.permutation([-1, 1])]
        if count == 2:
            return all([self.beside(self.anchor, piece, side) for side in sides])
        return any(self.beside(self.anchor, piece, side) for side in sides)

    def in_corner(self, models: list[Model]) -> Piece | None:
        """Place a seat in a corner, mostly turned from its wall towards the middle of the room."""
        walls = self.layout.walls

        def propose(piece: Piece) -> Piece:
            wall = walls[self.rng.integers(len(walls))]
            end, yaw = self.rng.choice([-1, 1]), yaw_at(wall)
            across = float(wall.direction @ (np.cos(yaw), -np.sin(yaw)))
            turn = -end * across * abs(self.random_turn(TURNED))
            half_x, half_z = piece.half_extent(turn)
            along = wall.length_m * (end + 1) / 2 - end * (half_x + self.rng.uniform(0.03, 0.6))
            off = half_z + self.rng.uniform(0.03, 0.1)
            return piece.at(*point_by(wall, along, off), yaw + turn)

        return self._try(models, 25, propose)

    def hang(
        self,
        models: list[Model],
        place: tuple[float, float],
        lowest: float,
        angled: float,
        yaw_rad: float = 0.0,
        spread: float = 0.05,
    ) -> Piece | None:
        """Hang a lamp from the ceiling above `place`, no part of it below `lowest`; its place
        varies with the standard deviation `spread`."""

        def propose(piece: Piece) -> Piece | None:
            bottom = self.layout.height - piece.size_m[1]
            if bottom < lowest:
                return None
            yaw = yaw_rad + self.random_turn(angled)
            x, z = place[0] + self.rng.normal(0, spread), place[1] + self.rng.normal(0, spread)
            return piece.at(x, z, yaw, bottom)

        return self._try(models, 20, propose)

    def lamp_position(self) -> tuple[float, float]:
        """Centre of the largest rectangle of the floor."""
        width, depth = self.layout.width, self.layout.depth
        range_x, range_z = self.layout.beside_notch
        if (range_x[1] - range_x[0]) * depth > (range_z[1] - range_z[0]) * width:
            return sum(range_x) / 2, depth / 2
        return width / 2, sum(range_z) / 2

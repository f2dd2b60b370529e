"""A floor plan drawn by a user: corners, doors and windows, and conversion from and to text."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from sceneprior.core.errors import InputError
from sceneprior.lifted.requests.openings import (
    DOOR_M,
    WINDOW_M,
    WantedOpening,
    read_openings,
    walls_of,
)
from sceneprior.lifted.requests.shape import LEAST_AREA_M2, Side, read_floor, sides_of

FIRST = "4x3"
"""Initial floor of a drawing, 4 x 3 metres."""
GRID_M = 0.1
"""Grid spacing for corners."""
STEP_M = 0.05
"""Spacing of the possible positions of a door or window along a wall."""

Point = tuple[float, float]


class Placed(NamedTuple):
    """A door or a window of a plan."""

    kind: str
    side: int
    """Index of the wall, which is also the index of the wall's first corner."""
    at_m: float
    """Distance from the wall's first corner to the middle of the opening."""

    @property
    def width_m(self) -> float:
        """Default width of a requested door or window."""
        return DOOR_M[0] if self.kind == "door" else WINDOW_M[0]


@dataclass(frozen=True)
class Plan:
    """A floor with doors and windows. Methods that change it return a new plan, or the same plan if
    the outline would intersect itself or become too small."""

    corners: tuple[Point, ...]
    """Corners x, z in metres, in order around the room."""
    openings: tuple[Placed, ...] = ()
    unplaced: tuple[str, ...] = ()
    """Texts of openings whose position is drawn at random."""

    @property
    def outline_m(self) -> Float[np.ndarray, "corners 2"]:
        """The corners as an array."""
        return np.array(self.corners)

    @property
    def sides(self) -> list[Side]:
        """The walls; wall 0 runs from corner 0 to corner 1."""
        return sides_of(self.outline_m)

    def floor_text(self) -> str:
        """The floor in the format of `--floor`: `4x3`, or a list of corners."""
        x, z = np.ptp(self.outline_m, axis=0)
        size = f"{_number(x)}x{_number(z)}"
        if len(self.corners) == 4 and np.allclose(read_floor(size), self.outline_m, atol=1e-6):
            return size
        return " ".join(f"{_number(x)},{_number(z)}" for x, z in self.corners)

    def openings_text(self) -> str:
        """The openings in the format of `--openings`."""
        placed = [f"{kind}@{side}:{_number(at_m)}" for kind, side, at_m in self.openings]
        return ", ".join([*placed, *self.unplaced])

    def ends_m(self, opening: Placed) -> Float[np.ndarray, "2 2"]:
        """Both ends (x, z) of an opening."""
        side = self.sides[opening.side]
        reach = opening.at_m + opening.width_m / 2 * np.array([[-1], [1]])
        return np.asarray(side.start_m + reach * side.along)

    def with_moved(self, corner: int, to: Point) -> "Plan":
        """Move a corner to the grid point nearest to `to`."""
        corners = [*self.corners]
        corners[corner] = (_on_grid(to[0]), _on_grid(to[1]))
        return self._with_corners(corners, self.openings)

    def with_corner(self, side: int, at: Point) -> "Plan":
        """Split a side at a new corner near `at`; the new corner's index is `side` + 1."""
        there = (_on_grid(at[0]), _on_grid(at[1]))
        corners = [*self.corners[: side + 1], there, *self.corners[side + 1 :]]
        cut_m = math.dist(self.corners[side], there)
        openings = [
            each._replace(side=each.side + 1)
            if each.side > side
            else each._replace(side=side + 1, at_m=each.at_m - cut_m)
            if each.side == side and each.at_m > cut_m
            else each
            for each in self.openings
        ]
        return self._with_corners(corners, openings)

    def without_corner(self, corner: int) -> "Plan":
        """Remove a corner; a triangle stays as it is."""
        count = len(self.corners)
        if count <= 3:
            return self
        before = (corner - 1) % count
        length_m = self.sides[before].length_m
        openings = [
            each._replace(side=before, at_m=each.at_m + length_m) if each.side == corner else each
            for each in self.openings
        ]
        openings = [
            each._replace(side=each.side - 1) if each.side > corner else each for each in openings
        ]
        corners = [each for row, each in enumerate(self.corners) if row != corner]
        return self._with_corners(corners, openings)

    def with_opening(self, kind: str, near: Point) -> "Plan":
        """Add a door or a window on the wall nearest to a point."""
        side, at_m = self._on_wall(near)
        return self._fitted([*self.openings, Placed(kind, side, at_m)])

    def with_opening_moved(self, number: int, near: Point) -> "Plan":
        """Move an opening to the position on a wall nearest to a point."""
        side, at_m = self._on_wall(near)
        moved = self.openings[number]._replace(side=side, at_m=at_m)
        openings = [*self.openings]
        openings[number] = moved
        return self._fitted(openings)

    def without_opening(self, number: int) -> "Plan":
        """Remove a door or a window."""
        left = tuple(each for row, each in enumerate(self.openings) if row != number)
        return replace(self, openings=left)

    def centred(self) -> "Plan":
        """Move the middle of the bounding box to the origin, as in requested rooms."""
        middle = (self.outline_m.min(axis=0) + self.outline_m.max(axis=0)) / 2
        corners = [(float(x), float(z)) for x, z in self.outline_m - middle]
        return replace(self, corners=tuple(corners))

    def _on_wall(self, near: Point) -> tuple[int, float]:
        lines = [shapely.LineString([side.start_m, side.end_m]) for side in self.sides]
        point = shapely.Point(near)
        side = int(np.argmin(shapely.distance(lines, point)))
        return side, float(lines[side].project(point))

    def _with_corners(self, corners: Sequence[Point], openings: Sequence[Placed]) -> "Plan":
        polygon = shapely.Polygon(corners)
        if not polygon.is_valid or polygon.area < LEAST_AREA_M2:
            return self
        return replace(self, corners=tuple(corners))._fitted(openings)

    def _fitted(self, openings: Sequence[Placed]) -> "Plan":
        """Replace the openings by `openings`, shifted along their walls to lie within them."""
        sides = self.sides
        fitted = []
        for each in openings:
            half_m, length_m = each.width_m / 2, sides[each.side].length_m
            at_m = round(each.at_m / STEP_M) * STEP_M
            last_m = math.floor(100 * (length_m - half_m) + 1e-6) / 100
            at_m = max(half_m, min(at_m, last_m))
            fitted.append(each._replace(at_m=round(at_m, 3)))
        return replace(self, openings=tuple(fitted))


def plan_of(floor: str, openings: str) -> Plan:
    """Build a plan from the texts of a request; without a floor, it has the floor `FIRST`.

    >>> plan = plan_of("4x3", "door@north:1, window")
    >>> plan.openings_text(), plan.with_opening("window", (1.9, 0.2)).openings_text()
    ('door@0:1, window', 'door@0:1, window@1:1.7, window')

    Raises:
        InputError: a text is no floor or no list of openings.
    """
    outline_m = read_floor(floor if floor.strip() else FIRST)
    plan = Plan(tuple((float(x), float(z)) for x, z in outline_m))
    placed, unplaced = [], []
    wanted = read_openings(openings) if openings.strip() else ()
    for each, text in zip(wanted, openings.split(","), strict=False):
        if isinstance(each, WantedOpening) and each.at_m is not None:
            side = walls_of(each, plan.sides)[0]
            x, z = side.start_m + each.at_m * side.along
            number, at_m = plan._on_wall((x, z))
            if not 0 <= each.at_m <= side.length_m:
                raise InputError(
                    f"A {each.kind} is {each.at_m:g} m along a wall of {side.length_m:.2f} m."
                )
            placed.append(Placed(each.kind, number, round(at_m, 3)))
        else:
            unplaced.append(text.strip())
    return replace(plan, openings=tuple(placed), unplaced=tuple(unplaced))


def _on_grid(value: float) -> float:
    return round(round(value / GRID_M) * GRID_M, 3)


def _number(value: float) -> str:
    return f"{round(float(value), 3):g}"

"""The floor of a requested room: its outline as users give it, and the rectangles in it."""

import re
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from sceneprior.core.checked import number_array
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening
from sceneprior.core.scene_json import check_floor, unit_guess
from sceneprior.core.shell import Wall, nearest_wall, rectangle, walls_of

NARROWEST_M = 0.3
"""Minimum side of a rectangle in which furniture is placed."""
SPACING_M = 0.25
"""Distance between the points on slanted sides at which rectangles may end."""
NEW_SHARE = 0.01
"""Share of the floor that a rectangle must cover beyond the larger ones to be kept."""
MOST_CELLS = 130**2
"""Largest number of cells between the coordinates at which rectangles may end; the memory of the
search in bytes is the square of this number."""
LEAST_AREA_M2 = 1.0
"""Smallest floor that can be requested."""
LONGEST_M = 60.0
"""Largest extent of a floor that can be requested; larger numbers are probably not in metres."""
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)")
_SIZE = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*(?:m\s*)?[xX×]\s*(\d+\.?\d*|\.\d+)\s*m?\s*")


class Floor:
    """The floor of a room, in metres (x, z); walls stand on its sides.

    Args:
        outline_m: Corners in order, in either direction.
    """

    def __init__(self, outline_m: Float[np.ndarray, "corners 2"]):
        self.outline_m = outline_m
        self.polygon = shapely.Polygon(outline_m)
        shapely.prepare(self.polygon)

    @cached_property
    def walls(self) -> list[Wall]:
        """The walls; wall 0 leads from corner 0 to corner 1."""
        return walls_of(self.outline_m)

    @cached_property
    def rectangles_m(self) -> Float[np.ndarray, "rectangles 4"]:
        """Axis-aligned rectangles in the floor (centre x, z and extents x, z), the largest first.
        Each covers a part of the floor that the larger ones do not (`NEW_SHARE`)."""
        return inner_rectangles(self.polygon)

    @property
    def is_rectangle(self) -> bool:
        """True if the floor is one rectangle along the axes."""
        whole = self.rectangle_m[2:].prod()
        return bool(abs(whole - self.polygon.area) < 1e-6 * whole)

    @cached_property
    def rectangle_m(self) -> Float[np.ndarray, "4"]:
        """The bounding rectangle: centre x, z and extents x, z."""
        low_x, low_z, high_x, high_z = self.polygon.bounds
        return np.array(
            [(low_x + high_x) / 2, (low_z + high_z) / 2, high_x - low_x, high_z - low_z]
        )

    @property
    def extents_m(self) -> Float[np.ndarray, "2"]:
        """Extents of the bounding rectangle, scaled to the floor's area. The room's contents are
        drawn given these extents."""
        extents_m = self.rectangle_m[2:]
        return np.asarray(extents_m * np.sqrt(self.polygon.area / extents_m.prod()))


class RoomShape(NamedTuple):
    """A floor with its doors and windows, and the height of the ceiling, if known."""

    floor: Floor
    openings: tuple[Opening, ...] = ()
    ceiling_m: float | None = None
    lacks: str = ""
    """Why requested doors or windows are left out, as a sentence."""

    def inward(self, opening: Opening) -> Float[np.ndarray, "2"]:
        """Unit normal, into the room, of the wall with this door or window."""
        middle = np.mean([opening.start_m, opening.end_m], axis=0)
        return self.floor.walls[nearest_wall(self.floor.walls, middle)].inward


def read_floor(floor: Any) -> np.ndarray:
    """Outline (corners, 2) of a floor, from `4x3` (metres along x and z, centred at the origin) or
    from a list of corners x, z in order, as numbers or text (`0,0 4,0 4,3`).

    Example:

        >>> read_floor("4x3").tolist()
        [[-2.0, -1.5], [2.0, -1.5], [2.0, 1.5], [-2.0, 1.5]]
        >>> read_floor("0,0 4,0 4,3").tolist()
        [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]]

    Raises:
        InputError: the floor is neither, intersects itself, or has less than `LEAST_AREA_M2`
            or extents above `LONGEST_M`.
    """
    if isinstance(floor, str):
        floor = _floor_of_text(floor)
    try:
        outline_m = number_array(floor)
    except (TypeError, ValueError):
        outline_m = np.zeros(0)
    if outline_m.ndim != 2 or len(outline_m) < 3 or outline_m.shape[1] != 2:
        raise InputError(
            "The floor is no polygon; expected at least 3 corners [x, z] in metres, in order."
        )
    check_floor("The request", outline_m)
    width_m, depth_m = np.ptp(outline_m, axis=0)
    if (longest_m := max(width_m, depth_m)) > LONGEST_M:
        raise InputError(
            f"The floor is {width_m:g} x {depth_m:g} m large; expected at most {LONGEST_M:g} m. "
            f"{unit_guess(longest_m)}"
        )
    outline_m = outline_m[(outline_m != np.roll(outline_m, -1, axis=0)).any(axis=1)]
    polygon = shapely.Polygon(outline_m)
    if not polygon.is_valid:
        raise InputError(
            f"The floor's outline intersects itself ({shapely.is_valid_reason(polygon)}); list "
            "its corners in order around the room."
        )
    if polygon.area < LEAST_AREA_M2:
        raise InputError(
            f"The floor has {polygon.area:.2g} square metres; expected at least "
            f"{LEAST_AREA_M2:g}. Sides are in metres."
        )
    return outline_m


def _floor_of_text(text: str) -> np.ndarray:
    """Parse a floor given as text: its size, or its corners."""
    if (found := _SIZE.fullmatch(text)) is not None:
        half = np.array([float(side) / 2 for side in found.groups()])
        return rectangle(-half, half)
    numbers = [float(number) for number in _NUMBER.findall(text)]
    if _NUMBER.sub("", text).strip(" ,;[]()\n\t") or len(numbers) < 6 or len(numbers) % 2:
        raise InputError(
            f"The floor is '{text[:60]}'; expected its size in metres, such as 4x3, at least 3 "
            "corners x,z in order, such as '0,0 5,0 5,3 2,3 2,5 0,5', or a file with a floor."
        )
    return np.array(numbers).reshape(-1, 2)


def inner_rectangles(polygon: shapely.Polygon) -> Float[np.ndarray, "rectangles 4"]:
    """The rectangles of `Floor.rectangles_m`. Their sides lie at corners of the floor or, for
    floors with slanted sides, at points every `SPACING_M` along the outline."""
    corners = np.array(polygon.exterior.coords)
    if (np.abs(np.diff(corners, axis=0)).min(axis=1) >= 1e-3).any():  # a slanted side
        corners = np.array([*corners, *shapely.segmentize(polygon, SPACING_M).exterior.coords])
    x, z = (np.unique(corners[:, axis].round(3)) for axis in (0, 1))
    if len(x) * len(z) > MOST_CELLS:
        raise InputError(
            f"The sides of the floor have {len(corners)} points at which furniture may begin, too "
            "many to search; give fewer corners, or a smaller floor without slanted sides."
        )
    room = polygon.buffer(2e-3, join_style="mitre")  # coordinates were rounded
    shapely.prepare(room)
    cells = shapely.box(x[:-1, None], z[None, :-1], x[1:, None], z[None, 1:])
    free = shapely.covers(room, cells)
    covered = np.pad(free, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    x0, x1 = np.triu_indices(len(x), 1)
    z0, z1 = np.triu_indices(len(z), 1)
    inside = (
        covered[x1[:, None], z1] - covered[x0[:, None], z1]
        - covered[x1[:, None], z0] + covered[x0[:, None], z0]
    )  # fmt: skip
    full = np.zeros((len(x) + 2,) * 2 + (len(z) + 2,) * 2, dtype=bool)  # from x, to x, from z, to z
    cells_within = (x1 - x0)[:, None] * (z1 - z0)
    full[x0[:, None] + 1, x1[:, None] + 1, z0 + 1, z1 + 1] = inside == cells_within
    inner = full[1:-1, 1:-1, 1:-1, 1:-1]
    larger = full[:-2, 1:-1, 1:-1, 1:-1] | full[1:-1, 2:, 1:-1, 1:-1]
    larger |= full[1:-1, 1:-1, :-2, 1:-1] | full[1:-1, 1:-1, 1:-1, 2:]
    x0, x1, z0, z1 = np.nonzero(inner & ~larger)
    low, high = np.stack([x[x0], z[z0]], axis=1), np.stack([x[x1], z[z1]], axis=1)
    areas = np.diff(x)[:, None] * np.diff(z)
    kept: list[int] = []
    for row in np.argsort(-(high - low).prod(axis=1), kind="stable"):
        own = np.s_[x0[row] : x1[row], z0[row] : z1[row]]
        new = (areas[own] * free[own]).sum() >= NEW_SHARE * polygon.area
        if new and (high[row] - low[row]).min() >= NARROWEST_M:
            kept.append(int(row))
            free[own] = False
    if not kept:
        raise InputError(
            f"The floor is nowhere {NARROWEST_M:g} m wide along both axes; furniture has no place."
        )
    return np.concatenate([(low + high) / 2, high - low], axis=1)[kept]

"""The outline of a room's floor: its polygon, the walls on its sides, openings and door swings."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening, Scene

MARGIN_M = 0.2
"""Distance between furniture and the edge of the assumed floor of scenes without one."""


class Wall(NamedTuple):
    """A wall along one side of the floor's outline, from the side's start to its end."""

    start_m: Float[np.ndarray, "2"]
    end_m: Float[np.ndarray, "2"]
    """End (x, z) of the inner face."""
    outward: Float[np.ndarray, "2"]
    """Unit normal (x, z) that points out of the room."""
    openings: tuple[tuple[float, float, float, float], ...] = ()
    """Doors and windows: start and end along the wall, bottom and top, in metres."""

    @property
    def length_m(self) -> float:
        """Length of the inner face."""
        return float(np.linalg.norm(self.end_m - self.start_m))

    @property
    def direction(self) -> Float[np.ndarray, "2"]:
        """Unit vector (x, z) from the start to the end."""
        return np.asarray((self.end_m - self.start_m) / max(self.length_m, 1e-9))

    @property
    def inward(self) -> Float[np.ndarray, "2"]:
        """Unit normal (x, z) that points into the room."""
        return -self.outward

    def distance_m(self, point_m: Float[np.ndarray, "2"]) -> float:
        """Distance of a point (x, z) from the inner face."""
        line = shapely.LineString([self.start_m, self.end_m])
        return float(line.distance(shapely.Point(point_m)))


def walls_of(outline_m: Float[np.ndarray, "corners 2"]) -> list[Wall]:
    """The walls on an outline of either orientation: wall 0 leads from corner 0 to corner 1."""
    following = np.roll(outline_m, -1, axis=0)
    x, z = outline_m.T
    turn = np.sign((x * following[:, 1] - following[:, 0] * z).sum())
    walls = []
    for start, end in zip(outline_m, following, strict=True):
        x, z = (end - start) / max(np.linalg.norm(end - start), 1e-9)
        walls.append(Wall(start, end, np.array([z, -x]) * turn))
    return walls


def nearest_wall(walls: Sequence[Wall], point_m: Float[np.ndarray, "2"]) -> int:
    """Index of the wall nearest to a point (x, z)."""
    return int(np.argmin([wall.distance_m(point_m) for wall in walls]))


def wall_of_opening(walls: Sequence[Wall], opening: Opening) -> int:
    """Index of the nearest wall parallel to a door or a window."""
    start, end = np.array(opening.start_m), np.array(opening.end_m)
    along = (end - start) / np.linalg.norm(end - start)
    middle = (start + end) / 2
    return int(np.argmin([w.distance_m(middle) + 10 * abs(along @ w.outward) for w in walls]))


def space_before(
    opening: Opening, inward: Float[np.ndarray, "2"], depth_m: float
) -> shapely.Polygon:
    """The rectangle of floor in front of an opening; in front of a door, the door swings in it if
    `depth_m` is the door's width."""
    start, end = np.array(opening.start_m), np.array(opening.end_m)
    return shapely.Polygon([start, end, end + depth_m * inward, start + depth_m * inward])


def floor_polygon(scene: Scene) -> shapely.Geometry | None:
    """The floor of a scene as a polygon; None if the scene has no outline."""
    if scene.floor_m is None:
        return None
    outline = np.asarray(scene.floor_m, dtype=np.float64)
    if outline.ndim == 2 and len(outline) >= 3 and outline.shape[1] == 2:
        floor = shapely.make_valid(shapely.Polygon(outline))
        if floor.area > 0:
            return floor
    raise InputError(
        f"The floor of scene '{scene.name}' has no area; `floor_m` lists at least 3 corners "
        "[x, z] in metres, or is left out."
    )


def free_floor(scene: Scene) -> shapely.Geometry | None:
    """The floor without the squares into which doors swing; None if the floor is unknown."""
    floor = floor_polygon(scene)
    if floor is None:
        return None
    doors = [o for o in scene.openings if o.kind == "door"]
    lines = [shapely.LineString([door.start_m, door.end_m]) for door in doors]
    return floor - shapely.union_all([line.buffer(line.length, cap_style="flat") for line in lines])


def floor_rectangle(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (x, z) of the rectangle around the floor; without a known floor, of
    the rectangle around the objects with a margin of 20 cm."""
    if scene.floor_m is not None and len(scene.floor_m):
        outline = np.asarray(scene.floor_m, dtype=np.float64)
        return outline.min(0), outline.max(0)
    if not scene.objects:
        return np.array([-1.5, -1.5]), np.array([1.5, 1.5])
    flat, half = scene.centers_m[:, [0, 2]], scene.sizes_m[:, [0, 2]] / 2
    return (flat - half).min(0) - MARGIN_M, (flat + half).max(0) + MARGIN_M


def rectangle(
    low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "4 2"]:
    """Corners (x, z) of an axis-aligned rectangle between two opposite corners."""
    return np.array([low, (high[0], low[1]), high, (low[0], high[1])])

"""The shell of a room: the outline of its floor, walls with doors and windows, and the ceiling."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from sceneprior.core.errors import InputError
from sceneprior.core.parts import prism, triangles_of
from sceneprior.core.scene import Mesh, Opening, Scene

MARGIN_M = 0.2
"""Distance between furniture and the edge of the assumed floor of scenes without one."""
ShellName = Literal["walls", "floor", "none"]
"""Parts of the shell to draw or write: all of them, the floor alone, or none."""
SHELLS: tuple[ShellName, ...] = ("walls", "floor", "none")
THICK_M = 0.1
"""Thickness of walls, floor and ceiling; walls stand outside the outline."""
HEIGHT_M = 2.6
"""Height of the ceiling if it is unknown, unless furniture is higher."""
ABOVE_M = 0.05
"""Minimum distance of an unknown ceiling from furniture that does not hang from it."""
LAMPS_FROM_M = 2.2
"""Height above which the top of a lamp is taken as the height of an unknown ceiling."""
FLAT_RAD = 1e-3
"""Angle between two sides of the outline below which their corner is left out."""


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


@dataclass(frozen=True)
class Shell:
    """Floor, walls and ceiling of a room."""

    outline_m: Float[np.ndarray, "corners 2"]
    """Outline (x, z) of the floor, on which the inner faces of the walls stand."""
    height_m: float
    walls: tuple[Wall, ...]
    grown_m: float
    """Largest distance by which a wall was moved outwards to make space for furniture."""

    def meshes(self) -> dict[str, Mesh]:
        """Closed meshes by name: `floor`, `wall_0` and so on, and `ceiling`."""
        named = {"floor": slab(self.outline_m, -THICK_M, 0.0)}
        starts = np.array([wall.start_m for wall in self.walls])
        away = _offset(self.walls, np.full(len(self.walls), THICK_M)) - starts
        # Outer corners are at most three thicknesses away from the inner ones.
        far = np.linalg.norm(away, axis=1, keepdims=True)
        corners = starts + away * np.minimum(1.0, 3 * THICK_M / far)
        for row, wall in enumerate(self.walls):
            outer = corners[[row, (row + 1) % len(corners)]]
            named[f"wall_{row}"] = _wall_mesh(wall, outer, self.height_m)
        named["ceiling"] = slab(self.outline_m, self.height_m, self.height_m + THICK_M)
        return named

    def inner_meshes(self) -> dict[str, Mesh]:
        """The floor, and the faces of walls and ceiling towards the room.

        In viewers that draw front faces only, walls between the camera and the room are invisible.
        The reveals of openings are left out: they would remain where their wall is invisible.
        """
        meshes = self.meshes()
        towards = {f"wall_{row}": -np.insert(w.outward, 1, 0.0) for row, w in enumerate(self.walls)}
        towards["ceiling"] = np.array([0.0, -1.0, 0.0])
        for name, way in towards.items():
            vertices, faces = meshes[name].vertices_m, meshes[name].faces
            a, b, c = (vertices[faces[:, corner]] for corner in range(3))
            normals = np.cross(b - a, c - a)
            # Faces whose normals point into the room, to 8 degrees.
            inner = normals @ way > 0.99 * np.linalg.norm(normals, axis=1)
            meshes[name] = Mesh(vertices, faces[inner])
        return meshes


def shell_meshes(scene: Scene, shell: ShellName) -> dict[str, Mesh]:
    """The meshes of a scene's shell that `shell` selects, by name."""
    if shell == "none":
        return {}
    meshes = shell_of(scene).meshes()
    return meshes if shell == "walls" else {"floor": meshes["floor"]}


def is_shell(node: str) -> bool:
    """True for the names of `Shell.meshes`."""
    return node in ("floor", "ceiling") or node.startswith("wall_")


def shell_of(scene: Scene) -> Shell:
    """The shell of a scene: on its floor, or on the rectangle around its furniture.

    A side that furniture crosses is moved outwards, together with its doors and windows. An unknown
    ceiling is at the top of the highest lamp, or else at 2.6 m.
    """
    outline = scene.floor_m
    if outline is None:
        outline = rectangle(*floor_rectangle(scene))
    plain = _corners(outline)
    grown, grown_m = _grown(plain, scene)
    walls = walls_of(grown)
    height = ceiling_height(scene)
    for opening in scene.openings:
        row = wall_of_opening(walls, opening)
        wall = walls[row]
        ends = (np.array(end) - wall.start_m for end in (opening.start_m, opening.end_m))
        start, end = sorted(float(end @ wall.direction) for end in ends)
        start, end = max(start, 0.0), min(end, wall.length_m)
        bottom, top = max(opening.bottom_m, 0.0), min(opening.top_m, height)
        if start < end and bottom < top:
            walls[row] = wall._replace(openings=(*wall.openings, (start, end, bottom, top)))
    return Shell(grown, height, tuple(walls), grown_m)


def ceiling_height(scene: Scene) -> float:
    """Height of a scene's ceiling. An unknown ceiling is at the top of the highest lamp, or else at
    2.6 m, or higher if furniture needs it."""
    if scene.ceiling_m is not None:
        return scene.ceiling_m
    tops = scene.centers_m[:, 1] + scene.sizes_m[:, 1] / 2
    lamps = np.array(["lamp" in item.label for item in scene.objects], dtype=bool)
    hung = tops[lamps & (tops > LAMPS_FROM_M)]
    others = tops[~lamps].max(initial=0) + ABOVE_M
    return float(max(hung.max(initial=0) or HEIGHT_M, others))


def _corners(outline_m: Float[np.ndarray, "corners 2"]) -> Float[np.ndarray, "some 2"]:
    """The outline in anticlockwise order (x right, z up), without corners on straight sides."""
    polygon = shapely.Polygon(outline_m)
    if not polygon.is_valid:
        raise InputError(
            "The outline of a floor (floor_m) crosses or touches itself, so no walls can stand on "
            "it; list its corners in order, each once."
        )
    polygon = shapely.remove_repeated_points(shapely.geometry.polygon.orient(polygon))
    corners = shapely.get_coordinates(polygon.exterior)[:-1]
    before, after = corners - np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0) - corners
    turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    sharp = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    return np.asarray(corners[np.abs(turn) > FLAT_RAD * sharp])


def _grown(
    corners: Float[np.ndarray, "corners 2"], scene: Scene
) -> tuple[Float[np.ndarray, "corners 2"], float]:
    """Move the sides of the outline outwards until it contains all furniture; also return the
    largest distance that a side moved."""
    walls = walls_of(corners)
    offsets = np.zeros(len(corners))
    here = corners
    for _ in range(4):
        floor, crossed = shapely.Polygon(here), False
        for item in scene.objects:
            center, half = np.array(item.center_m)[::2], np.array(item.size_m)[::2] / 2
            outside = shapely.box(*(center - half), *(center + half)).difference(floor)
            if outside.area < 1e-6:
                continue
            crossed = True
            for point in shapely.get_coordinates(outside):
                # The sides nearest to the point move outwards until they reach it.
                apart = np.array([wall.distance_m(point) for wall in walls_of(here)])
                for row in np.flatnonzero(apart <= apart.min() + 1e-9):
                    beyond = float((point - walls[row].start_m) @ walls[row].outward)
                    offsets[row] = max(offsets[row], beyond)
        if not crossed:
            return here, float(offsets.max())
        here = _offset(walls, offsets)
        if not shapely.Polygon(here).is_valid:
            break
    # If moving sides does not help, the outline becomes the rectangle around everything.
    low, high = floor_rectangle(replace(scene, floor_m=None))
    every = np.concatenate([corners, [low, high]])
    low, high = every.min(axis=0), every.max(axis=0)
    far = np.concatenate([corners.min(axis=0) - low, high - corners.max(axis=0)]).max()
    return rectangle(low, high), float(far)


def _offset(
    walls: Sequence[Wall], offsets: Float[np.ndarray, " corners"]
) -> Float[np.ndarray, "corners 2"]:
    """Corners of the outline after each side is moved outwards by its offset."""
    corners = []
    for row, wall in enumerate(walls):
        before = walls[row - 1]
        normals = np.array([before.outward, wall.outward])
        reach = [before.start_m @ before.outward, wall.start_m @ wall.outward]
        corners.append(np.linalg.solve(normals, np.array(reach) + offsets[[row - 1, row]]))
    return np.array(corners)


def slab(outline_m: Float[np.ndarray, "corners 2"], low_m: float, high_m: float) -> Mesh:
    """A closed mesh that fills an outline (x, z) between two heights."""
    return Mesh(*triangles_of(prism(outline_m, low_m, high_m)))


def _wall_mesh(
    wall: Wall,
    outer: Float[np.ndarray, "2 2"],
    height_m: float,
) -> Mesh:
    """A wall with mitred ends, from the lower face of the floor slab to the upper face of the
    ceiling slab, with its openings cut out."""
    from manifold3d import Manifold

    def hull(plan: Sequence[np.ndarray], low: float, high: float) -> Manifold:
        corners = np.array([(x, y, z) for x, z in plan for y in (low, high)])
        return Manifold.hull_points(corners)

    solid = hull([wall.start_m, wall.end_m, *outer], -THICK_M, height_m + THICK_M)
    for start, end, bottom, top in wall.openings:
        ends = [wall.start_m + wall.direction * at for at in (start, end)]
        deep = [end + wall.outward * side for end in ends for side in (-0.5, 0.5)]
        solid = solid - hull(deep, bottom, top)
    return Mesh(*triangles_of(solid))

"""The shell of a room: floor, walls with doors and windows cut out, and ceiling."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from sceneprior.core.errors import InputError
from sceneprior.core.outline import (
    Wall,
    floor_rectangle,
    rectangle,
    wall_of_opening,
    walls_of,
)
from sceneprior.core.parts import prism, triangles_of
from sceneprior.core.scene import Mesh, Opening, Scene

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


class Panel(NamedTuple):
    """A solid box of a wall, beside, below or above its openings."""

    center_m: Float[np.ndarray, "3"]
    size_m: tuple[float, float, float]
    """Length, height and thickness."""
    yaw_rad: float
    """Rotation about +y that takes +x to the direction of the wall."""


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
        corners = _outer_corners(self.walls)
        for row, wall in enumerate(self.walls):
            outer = (corners[row], corners[(row + 1) % len(corners)])
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
        return meshes | {name: _facing(meshes[name], way) for name, way in towards.items()}


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
    for opening in scene.openings:
        row, span = _place_of(opening, walls)
        walls[row] = walls[row]._replace(openings=(*walls[row].openings, span))
    height = ceiling_height(scene)
    walls = [_within(wall, height) for wall in walls]
    return Shell(grown, height, tuple(walls), grown_m)


def panels(wall: Wall, height_m: float) -> list[Panel]:
    """Boxes that fill a wall around its openings, from its start to its end."""
    direction = wall.direction
    cuts = sorted({0.0, wall.length_m, *(x for o in wall.openings for x in o[:2])})
    found = []
    for left, right in itertools.pairwise(cuts):
        middle = (left + right) / 2
        free = [(0.0, height_m)]
        for start, end, bottom, top in wall.openings:
            if start < middle < end:
                free = [
                    part
                    for low, high in free
                    for part in ((low, min(high, bottom)), (max(low, top), high))
                    if part[1] - part[0] > 1e-6
                ]
        for low, high in free:
            x, z = wall.start_m + direction * middle + wall.outward * THICK_M / 2
            found.append(
                Panel(
                    np.array([x, (low + high) / 2, z]),
                    (right - left, high - low, THICK_M),
                    float(np.arctan2(-direction[1], direction[0])),
                )
            )
    return found


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
    corners = shapely.get_coordinates(shapely.geometry.polygon.orient(polygon).exterior)[:-1]
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
                _push(point, here, walls, offsets)
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


def _push(
    point: Float[np.ndarray, "2"],
    corners: Float[np.ndarray, "corners 2"],
    walls: Sequence[Wall],
    offsets: Float[np.ndarray, " corners"],
) -> None:
    """Increase the offsets of the sides nearest to a point outside until they reach it."""
    apart = [wall.distance_m(point) for wall in walls_of(corners)]
    for row in np.flatnonzero(np.array(apart) <= min(apart) + 1e-9).tolist():
        beyond = float((point - walls[row].start_m) @ walls[row].outward)
        offsets[row] = max(offsets[row], beyond)


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


def _outer_corners(walls: Sequence[Wall]) -> list[Float[np.ndarray, "2"]]:
    """Corners of the walls' outer faces, at most three thicknesses away from the inner corner."""
    corners = _offset(walls, np.full(len(walls), THICK_M))
    cut = []
    for wall, corner in zip(walls, corners, strict=True):
        away = corner - wall.start_m
        far = float(np.linalg.norm(away))
        cut.append(wall.start_m + away * min(1.0, 3 * THICK_M / far))
    return cut


def _place_of(
    opening: Opening, walls: Sequence[Wall]
) -> tuple[int, tuple[float, float, float, float]]:
    """Index of the nearest wall parallel to an opening, and the opening as in `Wall.openings`."""
    row = wall_of_opening(walls, opening)
    ends = [
        float((np.array(point) - walls[row].start_m) @ walls[row].direction)
        for point in (opening.start_m, opening.end_m)
    ]
    low, high = sorted(ends)
    return row, (low, high, opening.bottom_m, opening.top_m)


def _within(wall: Wall, height_m: float) -> Wall:
    """The wall with openings cut to the wall's length and height."""
    spans = (
        (max(start, 0.0), min(end, wall.length_m), max(bottom, 0.0), min(top, height_m))
        for start, end, bottom, top in wall.openings
    )
    return wall._replace(openings=tuple(s for s in spans if s[0] < s[1] and s[2] < s[3]))


def slab(outline_m: Float[np.ndarray, "corners 2"], low_m: float, high_m: float) -> Mesh:
    """A closed mesh that fills an outline (x, z) between two heights."""
    return Mesh(*triangles_of(prism(outline_m, low_m, high_m)))


def _facing(mesh: Mesh, direction: Float[np.ndarray, "3"]) -> Mesh:
    """The faces of a mesh whose normals point in a direction, to 8 degrees."""
    a, b, c = (mesh.vertices_m[mesh.faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    return Mesh(
        mesh.vertices_m,
        mesh.faces[normals @ direction > 0.99 * np.linalg.norm(normals, axis=1)],
    )


def _wall_mesh(
    wall: Wall,
    outer: tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]],
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

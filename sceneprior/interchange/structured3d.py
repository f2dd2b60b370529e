"""Rooms of a house in Structured3D's `annotation_3d.json`: floor, doors, windows and ceiling.

The file lists junctions (points in millimetres, z up), lines between two junctions, and planes of
type floor, wall or ceiling. `planeLineMatrix` and `lineJunctionMatrix` say which line is on which
plane, and which junction is on which line. `semantics` groups planes: each room has its floor, its
walls and its ceiling, and each door or window the faces of the hole through the wall.

Source: data_organization.md of https://github.com/bertjiazheng/Structured3D.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sceneprior.core.checked import number_array, shown
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening
from sceneprior.core.scene_json import check_floor

KEYS = ("junctions", "lines", "planes", "semantics", "planeLineMatrix", "lineJunctionMatrix")
"""Keys by which an `annotation_3d.json` is recognized."""
HOLES = ("door", "window")
NOT_ROOMS = (*HOLES, "outwall")
"""Types of entries in `semantics` that are not rooms."""
AT_WALL_M = 0.03
"""Maximum distance in metres from a hole's corner to the room's wall. Walls are thicker, so the
hole's corners beyond this distance belong to the room on the other side."""
NARROWEST_M = 0.3
"""Minimum width of an opening in metres; narrower openings are left out."""
GRID_M = 0.001


class _House(NamedTuple):
    points_m: Float[np.ndarray, "junctions 3"]
    """Junctions as x, height, z."""
    ends: Int[np.ndarray, "lines 2"]
    """Junctions of each line."""
    plane_types: list[str]
    plane_lines: Bool[np.ndarray, "planes lines"]

    def lines_of(self, planes: list[int]) -> Int[np.ndarray, "some 2"]:
        """The ends of all lines on these planes."""
        return self.ends[self.plane_lines[planes].any(axis=0)]

    def planes_of_type(self, semantic: dict[str, Any], plane_type: str) -> list[int]:
        return [plane for plane in semantic["planeID"] if self.plane_types[plane] == plane_type]


def read_annotated_room(
    path: Path, data: dict[str, Any], name: str
) -> tuple[np.ndarray, tuple[Opening, ...], float | None]:
    """Floor outline (x, z), openings and ceiling height of one room, in metres. x and -z are the
    file's x and y, and the outline has a corner only where its walls turn.

    Args:
        name: The `ID` of the room, or its type if only one room has it; may be empty if the house
            has one room.

    Raises:
        InputError: the file is damaged, or has no such room.
    """
    try:
        house = _house(data)
        semantics = {str(each.get("ID", row)): each for row, each in enumerate(data["semantics"])}
        for each in semantics.values():
            if not all(0 <= plane < len(house.plane_types) for plane in each["planeID"]):
                raise ValueError(f"planeID {shown(each['planeID'])}")
        rooms = {
            key: each
            for key, each in semantics.items()
            if each["type"] not in NOT_ROOMS and house.planes_of_type(each, "floor")
        }
        holes = [each for each in semantics.values() if each["type"] in HOLES]
    except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(
            f"{path} is no annotation_3d.json of Structured3D ({type(error).__name__}: {error})."
        ) from None
    found = [key for key, each in rooms.items() if name in ("", key, each["type"])]
    if len(found) != 1:
        listed = ", ".join(f"{key} ({each['type']})" for key, each in rooms.items())
        raise InputError(
            f"{path} has the rooms {listed[:300] or 'none'}; name one of them as {path.name}:ROOM."
        )
    room = rooms[found[0]]
    floor = house.planes_of_type(room, "floor")
    outline_m = _outline(path, house, floor, found[0])
    floor_m = float(house.points_m[house.lines_of(floor)][..., 1].min())
    ceiling = house.lines_of(house.planes_of_type(room, "ceiling"))
    height_m = float(house.points_m[ceiling][..., 1].min()) - floor_m if len(ceiling) else None
    openings = tuple(
        opening
        for each in holes
        for corners_m in _corners_of_holes(house, each["planeID"])
        for opening in _openings(outline_m, corners_m - [0, floor_m, 0], each["type"])
    )
    return outline_m, openings, height_m


def _house(data: dict[str, Any]) -> _House:
    points_mm = number_array([each["coordinate"] for each in data["junctions"]])
    plane_lines = number_array(data["planeLineMatrix"]) != 0
    line_junctions = number_array(data["lineJunctionMatrix"]) != 0
    types = [each["type"] for each in data["planes"]]
    sizes = len(types), len(data["lines"]), len(points_mm)
    if points_mm.shape[1:] != (3,) or not np.isfinite(points_mm).all():
        raise ValueError("junctions have other coordinates than three numbers")
    if plane_lines.shape != sizes[:2] or line_junctions.shape != sizes[1:]:
        raise ValueError(
            f"{sizes[0]} planes, {sizes[1]} lines and {sizes[2]} junctions, but matrices of "
            f"{plane_lines.shape} and {line_junctions.shape}"
        )
    whole = line_junctions.sum(axis=1) == 2  # a line without two ends bounds nothing
    ends = np.nonzero(line_junctions[whole])[1].reshape(-1, 2)
    return _House(points_mm[:, [0, 2, 1]] / [1000, 1000, -1000], ends, types, plane_lines[:, whole])


def _outline(path: Path, house: _House, floor: list[int], room: str) -> np.ndarray:
    """Corners of the largest polygon that the lines of the floor's planes enclose."""
    lines = shapely.linestrings(house.points_m[house.lines_of(floor)][..., [0, 2]])
    noded = shapely.union_all(lines, grid_size=GRID_M)
    whole = shapely.union_all(shapely.get_parts(shapely.polygonize([noded])), grid_size=GRID_M)
    if whole.is_empty:
        raise InputError(f"{path}: the lines of the floor of room {room} enclose no area.")
    largest = max(shapely.get_parts(whole), key=shapely.area)
    # Holes such as columns are filled; corners of doors, in the middle of a wall, are left out.
    outline_m = np.asarray(
        shapely.Polygon(largest.exterior).normalize().simplify(GRID_M).exterior.coords
    )
    check_floor(path, outline_m[:-1])
    return outline_m[:-1]


def _corners_of_holes(house: _House, planes: list[int]) -> list[Float[np.ndarray, "corners 3"]]:
    """Corners of each hole: junctions of these planes that are connected by lines."""
    ends = house.lines_of(planes)
    links = coo_matrix((np.ones(len(ends)), ends.T), shape=(len(house.points_m),) * 2)
    hole = connected_components(links, directed=False)[1]
    used = np.unique(ends)
    return [house.points_m[used[hole[used] == each]] for each in np.unique(hole[used])]


def _openings(
    outline_m: Float[np.ndarray, "sides 2"], corners_m: Float[np.ndarray, "corners 3"], kind: Any
) -> list[Opening]:
    """The openings that a hole makes in the walls of a room."""
    found = []
    for start, end in zip(outline_m, np.roll(outline_m, -1, axis=0), strict=True):
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        offset = corners_m[:, [0, 2]] - start
        at_wall = corners_m[np.abs(offset @ [-along[1], along[0]]) <= AT_WALL_M]
        if not len(at_wall):
            continue
        reach = ((at_wall[:, [0, 2]] - start) @ along).clip(0, length)
        bottom_m, top_m = at_wall[:, 1].clip(min=0)[
            [at_wall[:, 1].argmin(), at_wall[:, 1].argmax()]
        ]
        if np.ptp(reach) >= NARROWEST_M and top_m > bottom_m:
            first, last = (start + along * way for way in (reach.min(), reach.max()))
            found.append(
                Opening(
                    kind, tuple(first.tolist()), tuple(last.tolist()), float(bottom_m), float(top_m)
                )
            )
    return found

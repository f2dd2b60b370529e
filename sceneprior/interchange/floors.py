"""Floors from files: polygons, scenes, ATISS's boxes, and houses of 3D-FRONT and Structured3D; and
floors as triangles.

The `annotation_3d.json` of Structured3D lists junctions (points in millimetres, z up), lines
between two junctions, and planes of type floor, wall or ceiling. `planeLineMatrix` and
`lineJunctionMatrix` say which line is on which plane, and which junction is on which line.
`semantics` groups planes: each room has its floor, its walls and its ceiling, and each door or
window the faces of the hole through the wall.

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
from sceneprior.core.files import read_arrays, read_json
from sceneprior.core.scene import Opening
from sceneprior.core.scene_json import FORMAT, check_floor, read_scene
from sceneprior.core.shell import walls_of

FLOOR = ("floor_plan_vertices", "floor_plan_faces", "floor_plan_centroid")
"""Arrays of a floor in ATISS's box lists."""
FINEST_M = 0.02
"""Tolerance in metres for simplifying floors made of triangles, so that walls are straight."""
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


class FloorPlan(NamedTuple):
    """Outline, openings and ceiling of a room, in metres."""

    outline_m: np.ndarray
    """Corners (x, z)."""
    openings: tuple[Opening, ...] = ()
    ceiling_m: float | None = None


def read_floor_file(name: str) -> FloorPlan:
    """The floor of `FILE`, or of the room ROOM of `FILE:ROOM`.

    A file is a JSON list of corners [x, z]; a scene's JSON; ATISS's `boxes.npz`; a house of
    3D-FRONT, with the `instanceid` of a room; or the `annotation_3d.json` of Structured3D, with the
    `ID` or the type of a room.

    Raises:
        InputError: the file has no floor, or several rooms of which none is named.
    """
    file, _, room = name.partition(":")
    path = Path(file)
    if path.suffix == ".npz":
        return FloorPlan(_atiss_floor(path))
    data = read_json(path)
    if isinstance(data, list):
        try:
            outline_m = number_array(data)
        except (TypeError, ValueError):
            outline_m = np.zeros(0)
        if outline_m.ndim != 2 or len(outline_m) < 3 or outline_m.shape[1] != 2:
            raise InputError(f"{path} lists no floor; expected at least 3 corners [x, z] (metres).")
        check_floor(path, outline_m)
        return FloorPlan(outline_m)
    if isinstance(data, dict):
        if data.get("format") == FORMAT:
            scene = read_scene(path)
            if scene.floor_m is None:
                raise InputError(f"{path} is a scene without a floor; give one with floor_m.")
            return FloorPlan(scene.floor_m, scene.openings, scene.ceiling_m)
        if "scene" in data and "mesh" in data:
            return FloorPlan(_front_floor(path, data, room))
        if data.keys() >= set(KEYS):
            return _annotated_room(path, data, room)
    raise InputError(
        f"{path} is no floor; expected a list of corners, a scene's JSON, ATISS's boxes.npz, a "
        "house of 3D-FRONT or Structured3D's annotation_3d.json."
    )


def _largest_outline(floor: shapely.Geometry) -> np.ndarray:
    """Corners of the largest polygon of a floor; its holes are filled."""
    largest = max(shapely.get_parts(floor), key=shapely.area)
    return np.asarray(largest.exterior.coords)[:-1]


def floor_plan(floor: shapely.Geometry) -> dict[str, np.ndarray]:
    """Convert a floor polygon to ATISS's arrays: triangles at y = 0 that face up, and the origin as
    centroid.

    >>> floor_plan(shapely.box(-1, -1, 1, 1))["floor_plan_faces"].shape
    (2, 3)
    """
    # A polygon with repeated corners cannot be triangulated.
    floor = shapely.remove_repeated_points(floor)
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(floor))
    # Counter-clockwise in (x, z) faces down with y up, so the order is reversed.
    corners = [np.asarray(shapely.orient_polygons(part).exterior.coords)[2::-1] for part in parts]
    flat = np.concatenate(corners)
    return {
        "floor_plan_vertices": np.insert(flat, 1, 0.0, axis=1),
        "floor_plan_faces": np.arange(len(flat)).reshape(-1, 3),
        "floor_plan_centroid": np.zeros(3),
    }


def floor_outline(path: Path, room: dict[str, Any]) -> np.ndarray | None:
    """Outline of the floor's triangles relative to its centroid, the origin of ATISS's boxes."""
    if any(key not in room for key in FLOOR):
        return None
    try:
        vertices, faces, centroid = (np.asarray(room[key]) for key in FLOOR)
        flat = (vertices.astype(np.float64) - centroid)[:, [0, 2]]
        check_floor(path, flat)
        # buffer(0) makes the triangles valid, so that their union is one outline.
        triangles = [shapely.Polygon(flat[face]).buffer(0) for face in faces]
        return _largest_outline(shapely.union_all(triangles))
    except InputError:
        raise
    except (ValueError, IndexError, TypeError, OverflowError, shapely.errors.ShapelyError) as error:
        raise InputError(
            f"{path}: its floor plan cannot be read ({error}); expected vertices (V, 3), "
            "triangles (F, 3) and a centroid (3,)."
        ) from None


def _atiss_floor(path: Path) -> np.ndarray:
    outline_m = floor_outline(path, read_arrays(path, only=FLOOR))
    if outline_m is None:
        raise InputError(f"{path} has no floor; expected {', '.join(FLOOR)}.")
    return outline_m


def _front_floor(path: Path, house: dict[str, Any], room_id: str) -> np.ndarray:
    """Outline of the floor of a room in a house: the largest polygon in the union of its floor
    meshes."""
    try:
        rooms = {str(room["instanceid"]): room for room in house["scene"]["room"]}
        if room_id not in rooms and (room_id or len(rooms) != 1):
            listed = ", ".join(rooms)[:300] or "none"
            raise InputError(
                f"{path} has the rooms {listed}; name one of them as {path.name}:ROOM."
            )
        room = rooms[room_id] if room_id else next(iter(rooms.values()))
        meshes = {mesh["uid"]: mesh for mesh in house["mesh"] if mesh["type"] == "Floor"}
        refs = [child["ref"] for child in room["children"] if child["ref"] in meshes]
        triangles = []
        for ref in refs:
            corners = np.array(meshes[ref]["xyz"], dtype=np.float64).reshape(-1, 3)[:, [0, 2]]
            triangles += list(corners[np.array(meshes[ref]["faces"], dtype=int).reshape(-1, 3)])
        if not np.isfinite(triangles).all():
            raise ValueError("xyz of a floor is not finite")
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise InputError(
            f"{path} is no house of 3D-FRONT ({type(error).__name__}: {error})."
        ) from None
    whole = shapely.union_all([shapely.Polygon(each).buffer(1e-3) for each in triangles])
    largest = max(shapely.get_parts(whole), key=shapely.area, default=whole)
    largest = largest.buffer(-1e-3, join_style="mitre")
    if largest.is_empty:
        raise InputError(f"{path}: room {room_id or room['instanceid']} has no floor.")
    outline_m = _largest_outline(largest.simplify(FINEST_M))
    check_floor(path, outline_m)
    return outline_m


class _House(NamedTuple):
    points_m: Float[np.ndarray, "junctions 3"]
    """Junctions as x, height, z."""
    ends: Int[np.ndarray, "lines 2"]
    """Junctions of each line."""
    plane_types: list[str]
    plane_lines: Bool[np.ndarray, "planes lines"]

    def lines_of(
        self, semantic: dict[str, Any], plane_type: str | None = None
    ) -> Int[np.ndarray, "some 2"]:
        """The ends of all lines on the planes of an entry of `semantics`, of one type or all."""
        planes = [p for p in semantic["planeID"] if plane_type in (None, self.plane_types[p])]
        return self.ends[self.plane_lines[planes].any(axis=0)]


def _annotated_room(path: Path, data: dict[str, Any], name: str) -> FloorPlan:
    """One room of a house of Structured3D, in metres. x and -z are the file's x and y, and the
    outline has a corner only where its walls turn.

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
        holes = [each for each in semantics.values() if each["type"] in HOLES]
        rooms = {
            key: each
            for key, each in semantics.items()
            if each["type"] not in NOT_ROOMS
            and "floor" in [house.plane_types[plane] for plane in each["planeID"]]
        }
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
    floor, ceiling = (
        house.points_m[house.lines_of(rooms[found[0]], kind)] for kind in ("floor", "ceiling")
    )
    noded = shapely.union_all(shapely.linestrings(floor[..., [0, 2]]), grid_size=GRID_M)
    whole = shapely.union_all(shapely.get_parts(shapely.polygonize([noded])), grid_size=GRID_M)
    if whole.is_empty:
        raise InputError(f"{path}: the lines of the floor of room {found[0]} enclose no area.")
    # Holes such as columns are filled; corners of doors, in the middle of a wall, are left out.
    filled = shapely.Polygon(_largest_outline(whole)).normalize()
    outline_m = _largest_outline(filled.simplify(GRID_M))
    check_floor(path, outline_m)
    floor_m = float(floor[..., 1].min())
    openings = tuple(
        opening
        for each in holes
        for corners_m in _corners_of_holes(house, each)
        for opening in _openings(outline_m, corners_m - [0, floor_m, 0], each["type"])
    )
    height_m = float(ceiling[..., 1].min()) - floor_m if len(ceiling) else None
    return FloorPlan(outline_m, openings, height_m)


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


def _corners_of_holes(
    house: _House, semantic: dict[str, Any]
) -> list[Float[np.ndarray, "corners 3"]]:
    """Corners of each hole of a door or window: junctions that are connected by lines."""
    ends = house.lines_of(semantic)
    links = coo_matrix((np.ones(len(ends)), ends.T), shape=(len(house.points_m),) * 2)
    hole = connected_components(links, directed=False)[1]
    used = np.unique(ends)
    return [house.points_m[used[hole[used] == each]] for each in np.unique(hole[used])]


def _openings(
    outline_m: Float[np.ndarray, "sides 2"], corners_m: Float[np.ndarray, "corners 3"], kind: Any
) -> list[Opening]:
    """The openings that a hole makes in the walls of a room."""
    found = []
    for wall in walls_of(outline_m):
        offset_m = corners_m[:, [0, 2]] - wall.start_m
        near = np.abs(offset_m @ wall.outward) <= AT_WALL_M
        if not near.any():
            continue
        reach_m = (offset_m[near] @ wall.direction).clip(0, wall.length_m)
        heights_m = corners_m[near, 1].clip(min=0)
        bottom_m, top_m = float(heights_m.min()), float(heights_m.max())
        if np.ptp(reach_m) >= NARROWEST_M and top_m > bottom_m:
            ways_m = np.array([reach_m.min(), reach_m.max()])
            start, end = map(tuple, (wall.start_m + wall.direction * ways_m[:, None]).tolist())
            found.append(Opening(kind, start, end, bottom_m, top_m))
    return found

"""Import of floors from files: polygons, scenes, ATISS's boxes, and houses of 3D-FRONT and
Structured3D."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely

from sceneprior.core.checked import number_array
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.scene import Opening
from sceneprior.core.scene_json import FORMAT, check_floor, read_scene
from sceneprior.interchange.box_lists import FLOOR, floor_outline
from sceneprior.interchange.structured3d import KEYS, read_annotated_room

FINEST_M = 0.02
"""Tolerance in metres for simplifying floors made of triangles, so that walls are straight."""


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
    if isinstance(data, dict) and data.get("format") == FORMAT:
        scene = read_scene(path)
        if scene.floor_m is None:
            raise InputError(f"{path} is a scene without a floor; give one with floor_m.")
        return FloorPlan(scene.floor_m, scene.openings, scene.ceiling_m)
    if isinstance(data, dict) and "scene" in data and "mesh" in data:
        return FloorPlan(_front_floor(path, data, room))
    if isinstance(data, dict) and data.keys() >= set(KEYS):
        return FloorPlan(*read_annotated_room(path, data, room))
    raise InputError(
        f"{path} is no floor; expected a list of corners, a scene's JSON, ATISS's boxes.npz, a "
        "house of 3D-FRONT or Structured3D's annotation_3d.json."
    )


def _atiss_floor(path: Path) -> np.ndarray:
    try:
        with np.load(path, allow_pickle=False) as file:
            record = {key: file[key] for key in FLOOR if key in file}
    except Exception as error:  # a damaged file raises almost anything in numpy
        raise InputError(f"{path} cannot be read ({type(error).__name__}).") from None
    outline_m = floor_outline(path, record)
    if outline_m is None:
        raise InputError(f"{path} has no floor; expected {', '.join(FLOOR)}.")
    return outline_m


def _front_floor(path: Path, house: dict[str, Any], room_id: str) -> np.ndarray:
    """Outline of the floor of a room in a house: the largest polygon in the union of its floor
    meshes."""
    try:
        rooms = {str(room["instanceid"]): room for room in house["scene"]["room"]}
        if room_id not in rooms and (room_id or len(rooms) != 1):
            listed = ", ".join(rooms)
            raise InputError(
                f"{path} has the rooms {listed[:300]}; name one of them as {path.name}:ROOM."
            )
        room = rooms[room_id] if room_id else next(iter(rooms.values()))
        meshes = {mesh["uid"]: mesh for mesh in house["mesh"] if mesh["type"] == "Floor"}
        refs = [child["ref"] for child in room["children"] if child["ref"] in meshes]
        triangles = []
        for ref in refs:
            corners = np.array(meshes[ref]["xyz"], dtype=np.float64).reshape(-1, 3)[:, [0, 2]]
            triangles += list(corners[np.array(meshes[ref]["faces"], dtype=int).reshape(-1, 3)])
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(
            f"{path} is no house of 3D-FRONT ({type(error).__name__}: {error})."
        ) from None
    whole = shapely.union_all([shapely.Polygon(each).buffer(1e-3) for each in triangles])
    if whole.is_empty:
        raise InputError(f"{path}: room {room_id or room['instanceid']} has no floor.")
    largest = max(shapely.get_parts(whole), key=shapely.area)
    largest = largest.buffer(-1e-3, join_style="mitre").simplify(FINEST_M)
    outline_m = np.asarray(largest.exterior.coords)[:-1]
    check_floor(path, outline_m)
    return outline_m

"""Writes homes and furniture to disk in the layout of 3D-FRONT and 3D-FUTURE."""

import json
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.homes.layout import DOOR_M, Layout, Piece, point_by
from sceneprior.core.shell import Wall
from sceneprior.furniture.catalog import Model

WALL_M = 0.12
"""Thickness of a wall."""
_DOOR_HEIGHT_M = 2.0
_BEFORE_WALL_M = 0.005
"""Distance by which doors and windows stand in front of their wall, which has no hole."""

_IDENTITY = {"pos": [0, 0, 0], "rot": [0, 0, 0, 1], "scale": [1, 1, 1]}


@dataclass(frozen=True)
class PlacedRoom:
    """A furnished room, its names in the data set, and the position of its corner in the house."""

    layout: Layout
    kind: str
    instanceid: str
    x: float
    z: float


def write_model(folder: Path, model: Model) -> None:
    """Write `<jid>/raw_model.obj`: metres, y up, front +z."""
    home = folder / model.jid
    home.mkdir(parents=True)
    # Sines differ in their last bits from CPU to CPU, and halves of sizes end with 0.00005.
    vertices_m = (np.round(model.mesh.vertices, 9) + 0.0).tolist()
    lines = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in vertices_m]
    lines += [f"f {a} {b} {c}" for a, b, c in (model.mesh.faces + 1).tolist()]
    (home / "raw_model.obj").write_text("\n".join(lines) + "\n")


def model_record(model: Model) -> dict[str, Any]:
    """Entry of a model in `model_info.json`."""
    return {
        "model_id": model.jid,
        "super-category": model.super_category,
        "category": model.category,
        "style": model.style_name,
        "theme": None,
        "material": None,
    }


def house_json(uid: str, rooms: list[PlacedRoom]) -> dict[str, Any]:
    """Content of a house file; poses of children are in the house's frame, as in 3D-FRONT."""
    meshes: list[dict[str, Any]] = []
    catalog: dict[str, dict[str, Any]] = {}
    room_entries = []
    number = 100
    for room in rooms:
        children = []
        corner = np.array([room.x, 0.0, room.z])
        for kind, triangles in shell(room.layout):
            number += 1
            mesh = _mesh(uid, number, kind, triangles + corner)
            meshes.append(mesh)
            children.append({"ref": mesh["uid"], "instanceid": f"mesh/{number}", **_IDENTITY})
        for piece in room.layout.pieces:
            number += 1
            entry = catalog.setdefault(piece.model.jid, _furniture(uid, len(catalog), piece.model))
            children.append(_placement(entry["uid"], number, piece, room))
        room_entries.append(
            {
                "type": room.kind,
                "instanceid": room.instanceid,
                "size": round(room.layout.area, 2),
                **_IDENTITY,
                "children": children,
                "empty": 0,
            }
        )
    return {
        "uid": uid,
        "jobid": "",
        "design_version": "sceneprior-homes",
        "code_version": "1",
        "north_vector": [0, 1, 0],
        "furniture": list(catalog.values()),
        "mesh": meshes,
        "material": [],
        "lights": [],
        "extension": {},
        "scene": {"ref": "-1", **_IDENTITY, "room": room_entries},
        "groups": [],
        "materialList": [],
        "version": "2.0",
    }


def shell(layout: Layout) -> list[tuple[str, np.ndarray]]:
    """Floor, ceiling, walls and openings in the room's frame, each as (type, (triangles, 3, 3)).

    All but the outer walls face the room.
    """
    (x0, x1), (z0, z1) = layout.beside_notch
    rectangles = [(0.0, z0, layout.width, z1)]  # two if the floor is L-shaped
    if layout.notch is not None:
        rectangles.append((x0, layout.notch[1], x1, layout.notch[3]))
    tiles = np.concatenate(
        [
            _quad((x0, 0.0, z0), (x0, 0.0, z1), (x1, 0.0, z1), (x1, 0.0, z0))
            for x0, z0, x1, z1 in rectangles
        ]
    )
    ceiling = tiles[:, ::-1] + np.array([0.0, layout.height, 0.0])
    walls = layout.walls
    outward = np.array([wall.outward for wall in walls])
    outside = np.array(layout.outline) + WALL_M * (outward + np.roll(outward, 1, axis=0))
    ends = zip(np.roll(outside, -1, axis=0), outside, strict=True)
    inner = [_wall(wall.start_m, wall.end_m, layout.height) for wall in walls]
    outer = [_wall(*each, layout.height) for each in ends]
    return [
        ("Floor", tiles),
        ("Ceiling", ceiling),
        *(("WallInner", part) for part in inner),
        *(("WallOuter", part) for part in outer),
        ("Door", _opening(*layout.door, DOOR_M, 0.0, _DOOR_HEIGHT_M)),
        *(("Window", _opening(*window)) for window in layout.windows),
    ]


def _opening(wall: Wall, middle: float, width: float, bottom: float, top: float) -> np.ndarray:
    start, end = (
        np.array(point_by(wall, middle + side * width / 2, _BEFORE_WALL_M)) for side in (-1, 1)
    )
    return _wall(start, end, top, bottom)


def _wall(start: np.ndarray, end: np.ndarray, top: float, bottom: float = 0.0) -> np.ndarray:
    """Make a wall of two triangles; it faces left of the direction start to end in (x, z)."""
    (x0, z0), (x1, z1) = start, end
    return _quad((x0, bottom, z0), (x1, bottom, z1), (x1, top, z1), (x0, top, z0))


def _quad(*corners: tuple[float, float, float]) -> np.ndarray:
    """Two triangles, (2, 3, 3), of four corners, counter-clockwise where they face."""
    return np.array(corners)[[[0, 1, 2], [0, 2, 3]]]


def _mesh(uid: str, number: int, kind: str, triangles: np.ndarray) -> dict[str, Any]:
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = triangles.reshape(-1, 3)
    flat = [k for k in range(3) if k != int(np.argmax(np.abs(normals[0])))]
    return {
        "aid": [],
        "jid": "",
        "uid": f"{number}{uid[:8]}/0",
        "xyz": _rounded(points),
        "normal": _rounded(np.repeat(normals, 3, axis=0)),
        "uv": _rounded(points[:, flat]),
        "faces": list(range(len(points))),
        "material": "",
        "type": kind,
        "constructid": str(number),
    }


def _furniture(uid: str, index: int, model: Model) -> dict[str, Any]:
    width, height, depth = model.size_m
    return {
        "uid": f"{1000 + index}/model",
        "jid": model.jid,
        "aid": [],
        "title": f"{model.super_category.lower()}/{model.category.lower()}",
        "type": "standard",
        "category": model.category,
        "sourceCategoryId": str(uuid.uuid5(uuid.NAMESPACE_OID, model.category)),
        "size": [width, depth, height],
        "bbox": [width, depth, height],
        "valid": True,
    }


def _placement(ref: str, number: int, piece: Piece, room: PlacedRoom) -> dict[str, Any]:
    half = piece.yaw_rad / 2
    return {
        "ref": ref,
        "instanceid": f"furniture/{number}",
        "pos": _rounded(np.array([piece.x + room.x, piece.y, piece.z + room.z])),
        "rot": _rounded(np.array([0.0, np.sin(half), 0.0, np.cos(half)])),
        "scale": _rounded(np.array(piece.scale)),
    }


def _rounded(values: np.ndarray) -> list[float]:
    return (np.round(values.reshape(-1), 5) + 0.0).tolist()  # + 0.0 turns -0.0 into 0.0


def write_compact_json(path: Path, content: Any) -> None:
    """Write compact JSON; the same content gives the same bytes."""
    path.write_text(json.dumps(content, separators=(",", ":")) + "\n")

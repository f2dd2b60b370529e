"""Homes read back from disk, as any reader of 3D-FRONT would."""

import csv
import json
from importlib.resources import files
from pathlib import Path

import numpy as np
from shapely.geometry import Polygon

TYPES = {"bedroom": "front3d_bedroom", "living": "front3d_living"}
"""Room type -> its label set."""

BEDS = {"double_bed", "single_bed", "kids_bed"}


def class_of_category(room_type: str) -> dict[str, str]:
    column = {"bedroom": "bedroom_class", "living": "living_room_class"}[room_type]
    table = files("sceneprior.core").joinpath("front3d_categories.csv").read_text()
    return {row["model_info_category"]: row[column] for row in csv.DictReader(table.splitlines())}


def read_rooms(folder: Path, room_type: str) -> list[dict]:
    """Rooms with their floor polygon and, for each piece, class, oriented footprint and levels."""
    classes = class_of_category(room_type)
    info = json.loads((folder / "3D-FUTURE-model" / "model_info.json").read_text())
    names = {
        record["model_id"]: classes[record["category"].lower().replace(" / ", "/")]
        for record in info
    }
    bounds = {}
    for jid in names:
        lines = (folder / "3D-FUTURE-model" / jid / "raw_model.obj").read_text().splitlines()
        points = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
        bounds[jid] = (points.min(axis=0), points.max(axis=0))
    found = []
    for path in sorted((folder / "3D-FRONT").glob("*.json")):
        house = json.loads(path.read_text())
        assert house["uid"] == path.stem
        furniture = {entry["uid"]: entry for entry in house["furniture"]}
        meshes = {entry["uid"]: entry for entry in house["mesh"]}
        for room in house["scene"]["room"]:
            own = [meshes[c["ref"]] for c in room["children"] if c["ref"] in meshes]
            floor = [mesh for mesh in own if mesh["type"] == "Floor"]
            pieces = []
            for child in room["children"]:
                if child["ref"] in furniture:
                    assert furniture[child["ref"]]["valid"] is True
                    jid = furniture[child["ref"]]["jid"]
                    pieces.append(_piece(names[jid], *bounds[jid], child) | {"jid": jid})
            found.append(
                {
                    "id": f"{house['uid']}_{room['instanceid']}",
                    "house": house["uid"],
                    "type": room["type"],
                    "size": room["size"],
                    "floor": _floor(floor),
                    "height": max(max(mesh["xyz"][1::3]) for mesh in own),
                    "meshes": own,
                    "pieces": pieces,
                }
            )
    return found


def _piece(name: str, low: np.ndarray, high: np.ndarray, child: dict) -> dict:
    x, y, z, w = child["rot"]
    assert x == z == 0
    assert np.isclose(y * y + w * w, 1, atol=1e-4)
    yaw = 2 * np.arctan2(y, w)
    scale = np.array(child["scale"])
    low, high = low * scale, high * scale
    corners = [(low[0], low[2]), (high[0], low[2]), (high[0], high[2]), (low[0], high[2])]
    sin, cos = np.sin(yaw), np.cos(yaw)
    px, py, pz = child["pos"]
    turned = [(px + a * cos + b * sin, pz - a * sin + b * cos) for a, b in corners]
    return {
        "class": name,
        "yaw": yaw,
        "corners": turned,
        "footprint": Polygon(turned),
        "levels": (py + low[1], py + high[1]),
    }


def _floor(meshes: list[dict]) -> Polygon:
    points = np.concatenate([np.reshape(mesh["xyz"], (-1, 3)) for mesh in meshes])
    faces = np.reshape(meshes[0]["faces"], (-1, 3))
    union = Polygon()
    for face in faces:
        union = union.union(Polygon(points[face][:, [0, 2]]))
    return union

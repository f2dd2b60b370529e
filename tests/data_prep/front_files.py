"""A writer of small data sets in 3D-FRONT's format: boxes for furniture, rectangles for floors."""

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

BOX_FACES = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]


@dataclass
class FrontFolder:
    """3D-FRONT/ and 3D-FUTURE-model/ under one folder."""

    root: Path
    models: list[dict[str, Any]] = field(default_factory=list)

    @property
    def front(self) -> Path:
        return self.root / "3D-FRONT"

    @property
    def future(self) -> Path:
        return self.root / "3D-FUTURE-model"

    def model(self, jid: str, category: str | None, size: tuple[float, float, float]) -> None:
        """A box that stands on y = 0, as OBJ quads with a texture index, and an unused vertex."""
        w, h, d = size
        lines = ["mtllib model.mtl"]
        for z in (-d / 2, d / 2):
            for y in (0, h):
                for x in (-w / 2, w / 2):
                    lines.append(f"v {x} {y} {z}")
        lines += ["v 77 77 77", "vt 0 0"]
        lines += ["f " + " ".join(f"{corner}/1" for corner in face) for face in BOX_FACES]
        folder = self.future / jid
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "raw_model.obj").write_text("\n".join(lines) + "\n")
        self.list_model(jid, category)

    def list_model(self, jid: str, category: str | None) -> None:
        self.future.mkdir(parents=True, exist_ok=True)
        self.models.append({"model_id": jid, "super-category": "X", "category": category})
        (self.future / "model_info.json").write_text(json.dumps(self.models))

    def house(self, uid: str, *rooms: dict[str, Any], **changes: Any) -> Path:
        """Write a house; every room is a dict from `room`."""
        data = {
            "uid": uid,
            "furniture": [entry for room in rooms for entry in room.pop("_furniture")],
            "mesh": [mesh for room in rooms for mesh in room.pop("_meshes")],
            "scene": {"room": list(rooms)},
            **changes,
        }
        self.front.mkdir(parents=True, exist_ok=True)
        path = self.front / f"{uid}.json"
        path.write_text(json.dumps(data))
        return path


def four_models(root: Path) -> FrontFolder:
    """Models for the rooms below, and no house yet."""
    folder = FrontFolder(root)
    folder.model("bed", "King-size Bed", (1.8, 1.0, 2.0))
    folder.model("stand", "Nightstand", (0.5, 0.6, 0.4))
    folder.model("lamp", "Floor Lamp", (0.3, 1.5, 0.3))
    folder.model("pendant", "Pendant Lamp", (0.4, 0.5, 0.4))
    return folder


def surface(uid: str, kind: str, corners: list[tuple[float, float, float]]) -> dict[str, Any]:
    """A quad as 3D-FRONT writes it: flat lists of numbers."""
    return {
        "uid": uid,
        "type": kind,
        "xyz": [float(value) for corner in corners for value in corner],
        "faces": [0, 2, 1, 0, 3, 2],
    }


def room(
    instanceid: str,
    pieces: list[dict[str, Any]],
    kind: str = "Bedroom",
    bounds: tuple[float, float, float, float] = (-2.0, -2.0, 2.0, 2.0),
    floor_y: float = 0.0,
    yaw_rad: float = 0.0,
) -> dict[str, Any]:
    """A room with a rectangular floor (x1, z1, x2, z2), turned by yaw about the world's origin."""
    x1, z1, x2, z2 = bounds
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)

    def turn(x: float, y: float, z: float) -> tuple[float, float, float]:
        return (cos * x + sin * z, y, -sin * x + cos * z)

    outline = [(x1, z1), (x2, z1), (x2, z2), (x1, z2)]
    meshes = [surface(f"floor-{instanceid}", "Floor", [turn(x, floor_y, z) for x, z in outline])]
    wall = [(x1, floor_y, z1), (x2, floor_y, z1), (x2, floor_y + 2.6, z1), (x1, floor_y + 2.6, z1)]
    meshes.append(surface(f"wall-{instanceid}", "WallInner", [turn(*corner) for corner in wall]))
    children = [{"ref": mesh["uid"], "instanceid": f"mesh/{mesh['uid']}"} for mesh in meshes]
    entries = []
    for i, item in enumerate(pieces):
        uid = f"{instanceid}/{i}"
        entries.append({"uid": uid, "jid": item["jid"], "valid": True, **item.get("entry", {})})
        angle = item.get("yaw", 0.0) + yaw_rad
        children.append(
            {
                "ref": uid,
                "pos": list(turn(*item["pos"])),
                "rot": item.get("rot", [0, math.sin(angle / 2), 0, math.cos(angle / 2)]),
                "scale": item.get("scale", [1, 1, 1]),
            }
        )
    return {
        "type": kind,
        "instanceid": instanceid,
        "children": children,
        "_furniture": entries,
        "_meshes": meshes,
    }


def bedroom(instanceid: str, **changes: Any) -> dict[str, Any]:
    """A bed, two nightstands and a floor lamp (void) in 4 x 4 m."""
    pieces = [
        {"jid": "bed", "pos": (0.0, 0.0, -1.0)},
        {"jid": "stand", "pos": (-1.4, 0.0, -1.8)},
        {"jid": "stand", "pos": (1.4, 0.0, -1.8), "yaw": math.pi / 2},
        {"jid": "lamp", "pos": (1.7, 0.0, 1.7)},
    ]
    return room(instanceid, pieces, **changes)

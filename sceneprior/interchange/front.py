"""Export in the formats of 3D-FRONT and 3D-FUTURE: one house per room, one model per object.

    <folder>/3D-FRONT/<room>.json
    <folder>/3D-FUTURE-model/model_info.json, <model id>/raw_model.obj

`prep-front` reads both. Units are metres, y is up, and rooms are centred at the origin.
"""

import math
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.errors import InputError
from sceneprior.core.files import json_text, write_json, write_whole
from sceneprior.core.furniture import MODEL_FILE, category_table, class_of_category
from sceneprior.core.scene import Scene, Turned
from sceneprior.core.shell import floor_polygon, floor_rectangle
from sceneprior.interchange.floors import floor_plan
from sceneprior.render.appearance import scene_meshes

ROOM_TYPES = {
    "front3d_bedroom": "Bedroom", "front3d_living": "LivingRoom", "front3d_dining": "DiningRoom",
    "front3d_library": "Library",
}  # fmt: skip
OTHER_ROOM = "OtherRoom"
_POSE = {"rot": [0, 0, 0, 1], "scale": [1, 1, 1]}


def write_front(scenes: Sequence[Scene], folder: Path) -> None:
    """Write a folder of houses and a folder of models.

    Each object's mesh, or its box, becomes a separate model, with a 3D-FUTURE category that maps to
    the object's class. An unknown floor is written as the rectangle around the furniture.
    """
    houses, models = Path(folder) / "3D-FRONT", Path(folder) / "3D-FUTURE-model"
    records: list[dict[str, Any]] = []
    for scene in scenes:
        furniture, children = [], []
        for index, (item, mesh) in enumerate(zip(scene.objects, scene_meshes(scene), strict=True)):
            category = category_of_class(item.label, scene.label_set)
            jid = str(uuid.uuid5(uuid.NAMESPACE_OID, f"{scene.name}/{index}"))
            # As in 3D-FUTURE, a model's origin is the centre of its lower face.
            x, y, z = item.center_m
            own = item.turned or Turned(0.0, item.size_m)
            width, height, depth = own.size_m
            origin = np.array([x, y - height / 2, z])
            vertices = np.asarray(mesh.vertices_m, dtype=np.float64) - origin
            vertices = vertices @ yaw_rotation(own.yaw_rad)  # back, to face +z
            lines = [f"v {a:.6f} {b:.6f} {c:.6f}" for a, b, c in vertices.tolist()]
            lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(mesh.faces) + 1).tolist()]
            write_whole(models / jid / MODEL_FILE, "\n".join(lines) + "\n")
            extent = [width, depth, height]
            furniture.append(
                {
                    "uid": f"{index}/model", "jid": jid, "category": category, "valid": True,
                    "size": extent, "bbox": extent,
                }
            )  # fmt: skip
            half = own.yaw_rad / 2
            turn = {"rot": [0, math.sin(half), 0, math.cos(half)]}
            place = {"instanceid": f"furniture/{index}", "pos": origin.tolist()} | _POSE | turn
            children.append({"ref": f"{index}/model"} | place)
            records.append({"model_id": jid, "super-category": "", "category": category})
        house = _house(scene, furniture, children)
        write_whole(houses / f"{scene.name}.json", json_text(house))
    write_json(models / "model_info.json", records)


def _house(
    scene: Scene, furniture: list[dict[str, Any]], children: list[dict[str, Any]]
) -> dict[str, Any]:
    """A house of one room, with its floor; `children` place the models that `furniture` lists."""
    (x0, z0), (x1, z1) = floor_rectangle(scene)
    plan = floor_plan(floor_polygon(scene) or shapely.box(x0, z0, x1, z1))
    vertices = plan["floor_plan_vertices"]
    floor = {
        "uid": "floor", "type": "Floor", "jid": "", "material": "",
        "xyz": vertices.ravel().tolist(), "faces": plan["floor_plan_faces"].ravel().tolist(),
        "normal": [0.0, 1.0, 0.0] * len(vertices), "uv": vertices[:, [0, 2]].ravel().tolist(),
    }  # fmt: skip
    ground = {"ref": "floor", "instanceid": "mesh/0", "pos": [0, 0, 0]} | _POSE
    kind = ROOM_TYPES.get(scene.label_set, OTHER_ROOM)
    room = {"type": kind, "instanceid": f"{kind}-0", "pos": [0, 0, 0], "empty": 0} | _POSE
    return {
        "uid": scene.name, "version": "2.0", "design_version": "sceneprior",
        "furniture": furniture, "mesh": [floor],
        "scene": {"ref": "-1", "pos": [0, 0, 0], **_POSE,
                  "room": [room | {"children": [ground, *children]}]},
    }  # fmt: skip


def category_of_class(label: str, label_set_name: str) -> str:
    """A 3D-FRONT category that `prep-front` maps to a class.

    >>> category_of_class("double_bed", "front3d_bedroom")
    'double bed'
    """
    for category in (label, *category_table()):
        if class_of_category(category, label_set_name) == label:
            return category
    raise InputError(
        f"3D-FRONT has no category for class '{label}' of label set '{label_set_name}'; leave such "
        "objects out, or export to another format."
    )

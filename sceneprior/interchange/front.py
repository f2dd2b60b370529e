"""Write rooms as 3D-FRONT and 3D-FUTURE keep them: a house a room, a model an object.

    <folder>/3D-FRONT/<room>.json
    <folder>/3D-FUTURE-model/model_info.json, <model id>/raw_model.obj

`prep-front` reads both. Units are metres, y is up, and rooms stand about the origin, as ours do.
"""

import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.errors import InputError
from sceneprior.files import json_text, write_json, write_whole
from sceneprior.furniture import MODEL_FILE, category_table, class_of_category
from sceneprior.interchange.atiss import floor_plan
from sceneprior.scene import Scene
from sceneprior.topdown import floor_rectangle, scene_meshes

ROOM_TYPES = {
    "front3d_bedroom": "Bedroom", "front3d_living": "LivingRoom", "front3d_dining": "DiningRoom",
    "front3d_library": "Library",
}  # fmt: skip
OTHER_ROOM = "OtherRoom"
_POSE = {"rot": [0, 0, 0, 1], "scale": [1, 1, 1]}


def write_front(scenes: Sequence[Scene], folder: Path) -> None:
    """Write a folder of houses and one of models.

    An object's mesh, or its box, becomes a model of its own, whose category is one of 3D-FUTURE's
    that has the object's class. Where a room's floor is unknown, it is the rectangle around the
    furniture.

    Raises:
        InputError: no category of 3D-FUTURE has a class.
    """
    models: list[dict[str, Any]] = []
    for scene in scenes:
        house, records = _house(scene, Path(folder) / "3D-FUTURE-model")
        write_whole(Path(folder) / "3D-FRONT" / f"{scene.name}.json", json_text(house))
        models += records
    write_json(Path(folder) / "3D-FUTURE-model" / "model_info.json", models)


def _house(scene: Scene, models: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """A room's house, and the records of its models, whose files are written."""
    furniture: list[dict[str, Any]] = []
    children: list[dict[str, Any]] = []
    records: list[dict[str, Any]] = []
    for index, (item, mesh) in enumerate(zip(scene.objects, scene_meshes(scene), strict=True)):
        category = category_of_class(item.label, scene.label_set)
        jid = str(uuid.uuid5(uuid.NAMESPACE_OID, f"{scene.name}/{index}"))
        # A model stands on its own origin, as 3D-FUTURE's do.
        x, y, z = item.center_m
        origin = np.array([x, y - item.size_m[1] / 2, z])
        vertices = np.asarray(mesh.vertices_m, dtype=np.float64) - origin
        lines = [f"v {a:.6f} {b:.6f} {c:.6f}" for a, b, c in vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(mesh.faces) + 1).tolist()]
        write_whole(models / jid / MODEL_FILE, "\n".join(lines) + "\n")
        width, height, depth = item.size_m
        furniture.append(
            {
                "uid": f"{index}/model", "jid": jid, "category": category, "valid": True,
                "size": [width, depth, height], "bbox": [width, depth, height],
            }
        )  # fmt: skip
        children.append(
            {"ref": f"{index}/model", "instanceid": f"furniture/{index}", "pos": origin.tolist()}
            | _POSE
        )
        records.append({"model_id": jid, "super-category": "", "category": category})
    plan = floor_plan(_outline(scene))
    floor = {
        "uid": "floor", "type": "Floor", "jid": "", "material": "",
        "xyz": plan["floor_plan_vertices"].ravel().tolist(),
        "faces": plan["floor_plan_faces"].ravel().tolist(),
        "normal": [0.0, 1.0, 0.0] * len(plan["floor_plan_vertices"]),
        "uv": plan["floor_plan_vertices"][:, [0, 2]].ravel().tolist(),
    }  # fmt: skip
    ground = {"ref": "floor", "instanceid": "mesh/0", "pos": [0, 0, 0]} | _POSE
    kind = ROOM_TYPES.get(scene.label_set, OTHER_ROOM)
    room = {"type": kind, "instanceid": f"{kind}-0", "pos": [0, 0, 0], "empty": 0} | _POSE
    house = {
        "uid": scene.name, "version": "2.0", "design_version": "sceneprior",
        "furniture": furniture, "mesh": [floor],
        "scene": {"ref": "-1", "pos": [0, 0, 0], **_POSE,
                  "room": [room | {"children": [ground, *children]}]},
    }  # fmt: skip
    return house, records


def category_of_class(label: str, label_set_name: str) -> str:
    """A category that has a class, as `prep-front` reads it.

    >>> category_of_class("double_bed", "front3d_bedroom")
    'double bed'
    """
    for category in (label, *category_table()):
        if class_of_category(category, label_set_name) == label:
            return category
    raise InputError(
        f"No category of 3D-FRONT is a '{label}' in label set '{label_set_name}'; leave such "
        "objects out, or export to another format."
    )


def _outline(scene: Scene) -> np.ndarray:
    if scene.floor_m is not None:
        return scene.floor_m
    (x0, z0), (x1, z1) = floor_rectangle(scene)
    return np.array([[x0, z0], [x1, z0], [x1, z1], [x0, z1]])

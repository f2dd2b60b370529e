"""Export as a habitat-sim scene dataset: JSON configs and GLBs; y up, metres."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.colliders import colliders, is_fixed, mass_kg, mesh_of
from sceneprior.core.files import write_json, write_whole
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.core.shell import ShellName, shell_meshes
from sceneprior.render.appearance import node_names, scene_meshes
from sceneprior.render.scene_files import scene_to_glb

DATASET_FILE = "rooms.scene_dataset_config.json"
UP, FRONT = [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]
"""Axes of a habitat-sim asset. (A `SceneObject` faces +z in its own frame.)"""


def write_habitat(scenes: Sequence[Scene], folder: Path, shell: ShellName) -> None:
    """Write `rooms.scene_dataset_config.json` with the folders `stages`, `objects` and `scenes`.

    A stage is the shell of a room. An object has a GLB for rendering, a GLB of its convex bodies
    for collisions, a mass and a class (`semantic_id` is the index of the class in the label set).
    Hanging objects are static, all others dynamic. If the yaw of an object is known
    (`SceneObject.turned`), its asset faces -z and the scene instance rotates it; other assets keep
    the axes of the room.

    Source:
        The JSON attributes that aihabitat.org/docs/habitat-sim/attributesJSON documents, with the
        folders of HSSD (hssd/hssd-hab).
    """
    paths = {name: {"paths": {".json": [name]}} for name in ("stages", "objects")}
    scene_instances = {
        "paths": {".json": ["scenes"]},
        "default_attributes": {"default_lighting": ""},
    }
    write_json(folder / DATASET_FILE, {**paths, "scene_instances": scene_instances})
    for scene in scenes:
        stage = scene_to_glb(replace(scene, objects=()), shell_meshes(scene, shell))
        write_whole(folder / "stages" / f"{scene.name}.glb", stage)
        write_json(
            folder / "stages" / f"{scene.name}.stage_config.json",
            _asset(scene.name, scene.name) | {"origin": [0.0, 0.0, 0.0]},
        )
        instances = [
            _write_object(scene, item, mesh, index, f"{scene.name}_{node}", folder / "objects")
            for item, mesh, index, node in zip(
                scene.objects, scene_meshes(scene), scene.class_indices.tolist(), node_names(scene),
                strict=True,
            )
        ]  # fmt: skip
        write_json(
            folder / "scenes" / f"{scene.name}.scene_instance.json",
            {
                "stage_instance": {"template_name": f"stages/{scene.name}"},
                "default_lighting": "",
                "object_instances": instances,
            },
        )


def _write_object(
    scene: Scene, item: SceneObject, mesh: Mesh, index: int, name: str, folder: Path
) -> dict[str, Any]:
    """Write an object's config and GLBs, and return its entry in the scene instance."""
    yaw_rad = 0.0 if item.turned is None else item.turned.yaw_rad + np.pi
    back, center = yaw_rotation(yaw_rad), np.asarray(item.center_m)

    def glb(objects: Iterable[SceneObject]) -> bytes:
        alone = tuple(each.reshaped(lambda v: (v - center) @ back) for each in objects)
        return scene_to_glb(replace(scene, objects=alone, extra={}))

    bodies = (replace(item, mesh=mesh_of(b), solids=(), textured=()) for b in colliders(item))
    write_whole(folder / f"{name}.glb", glb([replace(item, mesh=mesh, solids=())]))
    write_whole(folder / f"{name}.collider.glb", glb(bodies))
    config = _asset(name, f"{name}.collider") | {
        "mass": mass_kg(item), "semantic_id": index, "join_collision_meshes": False,
    }  # fmt: skip
    write_json(folder / f"{name}.object_config.json", config)
    return {
        "template_name": f"objects/{name}",
        "translation_origin": "asset_local",
        "translation": [*item.center_m],
        "rotation": [float(np.cos(yaw_rad / 2)), 0.0, float(np.sin(yaw_rad / 2)), 0.0],
        "motion_type": "STATIC" if is_fixed(item) else "DYNAMIC",
    }


def _asset(drawn: str, collided: str) -> dict[str, Any]:
    return {
        "render_asset": f"{drawn}.glb", "collision_asset": f"{collided}.glb",
        "up": UP, "front": FRONT, "units_to_meters": 1.0,
    }  # fmt: skip

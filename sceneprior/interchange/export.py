"""Export of rooms to other formats, by name; writers for simulators and for SceneEval."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.colliders import colliders, is_fixed, mass_kg, mesh_of
from sceneprior.core.contact_resolution import Stable, make_stable
from sceneprior.core.errors import InputError
from sceneprior.core.files import write_json, write_whole
from sceneprior.core.parallel import check_shared, map_blocks
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.core.shell import THICK_M, Shell, ShellName, shell_meshes, shell_of
from sceneprior.interchange.box_lists import write_atiss
from sceneprior.interchange.front import write_front
from sceneprior.render.appearance import node_names, scene_meshes
from sceneprior.render.scene_files import check_names, save, scene_to_glb
from sceneprior.render.scene_simulators import scene_to_mjcf, scene_to_usd

PREFIX = "sceneprior"
"""Prefix of model ids, by which SceneEval identifies a model's data set."""
_Z_UP = {"up": [0, 0, 1], "front": [0, 1, 0]}
BLOCK = 16
"""Rooms that a task makes stable and writes."""
GROWN_M = 0.01
"""Threshold in metres: a note mentions walls that furniture pushed outwards by more."""


class Notes(NamedTuple):
    """Sentences for the user on an export."""

    changed: Sequence[str] = ()
    left_out: Sequence[str] = ()
    """Those on objects that the files lack."""


def export_scenes(
    scenes: Sequence[Scene], to: str, folder: Path, shell: ShellName | None = None
) -> Notes:
    """Write rooms to a folder in one of `FORMATS`, in metres, with y up (z in `mujoco` and
    `sceneeval`).

    Args:
        shell: The parts of the shell to write; None writes walls for simulators, and nothing in
            other formats.

    """
    if to not in FORMATS:
        raise InputError(f"No format '{to}'; choose from {', '.join(FORMATS)}, or scenes.")
    check_names(scenes)
    folder = Path(folder)
    if to in SIMULATORS:
        return _export_standing(scenes, to, folder, shell or "walls")
    if to == "obj":
        for scene in scenes:
            save(scene, folder / f"{scene.name}.obj", shell=shell or "none")
        return Notes()
    if shell is not None:
        raise InputError(f"The format {to} has no choice of walls and floors; leave out --shell.")
    if to == "sceneeval":
        write_sceneeval(scenes, folder)
        return Notes()
    named = [
        replace(scene, objects=tuple(o for o in scene.objects if o.label != "void"))
        for scene in scenes
    ]
    CLASS_FORMATS[to](named, folder)
    left_out = sum(len(a.objects) - len(b.objects) for a, b in zip(scenes, named, strict=True))
    if left_out:
        said = f"Objects of class void are left out ({left_out}): {to} has no such class."
        return Notes(left_out=[said])
    return Notes()


def _export_standing(scenes: Sequence[Scene], to: str, folder: Path, shell: ShellName) -> Notes:
    """Make objects stable and write the rooms, in tasks of `BLOCK` rooms."""
    folder.mkdir(parents=True, exist_ok=True)
    settle = partial(_settle, to, folder, shell)
    found = map_blocks(settle, scenes, BLOCK, "settling rooms")
    standing, notes = [each.scene for each in found], list[str]()
    changes = sum((each.changes for each in found), Counter[str]())
    if listed := ", ".join(f"{count} {change}" for change, count in changes.items() if count):
        total = sum(len(scene.objects) for scene in scenes)
        notes.append(
            f"Changed so that nothing falls over or overlaps: {listed} (of {total} objects)."
        )
    grown_m = [shell_of(scene).grown_m for scene in standing] if shell == "walls" else []
    if rooms := sum(far > GROWN_M for far in grown_m):
        notes.append(
            f"Walls of {rooms} rooms stand further out than floor_m, by up to {max(grown_m):.2f} "
            "m, because furniture stands there."
        )
    return Notes(notes, [said for each in found for said in each.left_out])


def _settle(
    to: str, folder: Path, shell: ShellName, scenes: Sequence[Scene], first: int
) -> list[Stable]:
    check_shared(folder)
    found = [make_stable(scene) for scene in scenes]
    SIMULATORS[to]([each.scene for each in found], folder, shell)
    return [each._replace(scene=each.scene.without_meshes()) for each in found]


def _write_mujoco(scenes: Sequence[Scene], folder: Path, shell: ShellName) -> None:
    for scene in scenes:  # the floor is always written
        room = shell_of(scene) if shell == "walls" else None
        write_whole(folder / f"{scene.name}.xml", scene_to_mjcf(scene, room))


def _write_usd(scenes: Sequence[Scene], folder: Path, shell: ShellName) -> None:
    for scene in scenes:
        text = scene_to_usd(scene, shell_meshes(scene, shell), physics=True)
        write_whole(folder / f"{scene.name}.usda", text)


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
    write_json(
        folder / "rooms.scene_dataset_config.json", {**paths, "scene_instances": scene_instances}
    )
    for scene in scenes:
        stage, path = replace(scene, objects=()), folder / "stages" / f"{scene.name}.glb"
        write_whole(path, scene_to_glb(stage, shell_meshes(scene, shell)))
        config = _asset(scene.name, scene.name) | {"origin": [0.0, 0.0, 0.0]}
        write_json(path.with_name(f"{scene.name}.stage_config.json"), config)
        instances = [
            _write_object(scene, item, mesh, index, f"{scene.name}_{node}", folder / "objects")
            for item, mesh, index, node in zip(
                scene.objects, scene_meshes(scene), scene.class_indices.tolist(), node_names(scene),
                strict=True,
            )
        ]  # fmt: skip
        room = {
            "stage_instance": {"template_name": f"stages/{scene.name}"},
            "default_lighting": "",
            "object_instances": instances,
        }
        write_json(folder / "scenes" / f"{scene.name}.scene_instance.json", room)


def _write_object(
    scene: Scene, item: SceneObject, mesh: Mesh, index: int, name: str, folder: Path
) -> dict[str, Any]:
    """Write an object's config and GLBs, and return its entry in the scene instance."""
    yaw_rad = 0.0 if item.turned is None else item.turned.yaw_rad + np.pi
    back, center = yaw_rotation(yaw_rad), np.asarray(item.center_m)

    def glb(objects: Iterable[SceneObject]) -> bytes:
        alone = tuple(
            replace(each.reshaped(lambda v: (v - center) @ back), turned=None) for each in objects
        )
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
    # A `SceneObject` faces +z in its own frame, an asset -z.
    return {
        "render_asset": f"{drawn}.glb", "collision_asset": f"{collided}.glb",
        "up": [0.0, 1.0, 0.0], "front": [0.0, 0.0, -1.0], "units_to_meters": 1.0,
    }  # fmt: skip


def write_sceneeval(scenes: Sequence[Scene], folder: Path) -> None:
    """Write `scene_<number>.json` in the order of the scenes, and a folder `assets/<id>` per model.

    The folder holds `<id>.glb`, the mesh with y up and the centre of the model's box as origin, and
    `data.json`, its class; SceneEval's data set class `layoutvlm_objathor` reads such folders.
    Objects are neither set down nor moved apart.

    Source:
        github.com/3dlg-hcvc/SceneEval: GUIDE.md, scene_state_template.json and scenes/.
    """
    for number, scene in enumerate(scenes):
        write_json(folder / f"scene_{number}.json", _scene_state(scene))
        names, meshes = node_names(scene), scene_meshes(scene)
        for name, item, mesh in zip(names, scene.objects, meshes, strict=True):
            model = f"{scene.name}_{name}"
            whole = replace(item, mesh=mesh, solids=())
            around = whole.reshaped(partial(np.add, -np.asarray(item.center_m)))
            alone = replace(scene, objects=(around,))
            write_whole(folder / "assets" / model / f"{model}.glb", scene_to_glb(alone))
            annotations = {"category": item.label, "description": item.label, "materials": []}
            write_json(folder / "assets" / model / "data.json", {"annotations": annotations})


def _scene_state(scene: Scene) -> dict[str, Any]:
    objects = []
    for index, (name, item) in enumerate(zip(node_names(scene), scene.objects, strict=True)):
        x, y, z = item.center_m
        # Column by column: +x stays, +y becomes up, +z becomes -y.
        columns = [float(each) for each in (1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, x, -z, y, 1)]
        objects.append(
            {
                "index": index, "id": name, "modelId": f"{PREFIX}.{scene.name}_{name}",
                "parentId": "", "transform": {"rows": 4, "cols": 4, "data": columns},
            }
        )  # fmt: skip
    return {
        "format": "sceneState",
        "scene": {
            "version": "scene@1.0.2", "id": scene.name, "unit": 1.0, **_Z_UP,
            "assetSource": [PREFIX], "arch": _architecture(scene.name, shell_of(scene)),
            "object": objects, "modifications": [],
        },
        "selected": [],
    }  # fmt: skip


def _architecture(name: str, shell: Shell) -> dict[str, Any]:
    room = {"roomId": "room", "materials": []}
    floor = [[x, -z, 0.0] for x, z in shell.outline_m[::-1].tolist()]
    elements: list[dict[str, Any]] = [
        {"id": "floor", "type": "Floor", "points": floor, "depth": THICK_M, **room}
    ]
    for row, wall in enumerate(shell.walls):
        length = wall.length_m
        # With z up, the outline has the opposite orientation, so each wall is written from its end.
        points = [[float(x), -float(z), 0.0] for x, z in (wall.end_m, wall.start_m)]
        holes = [
            {
                "id": f"hole_{row}_{number}",
                "type": "Door" if bottom <= 0 else "Window",
                "box": {"min": [length - end, bottom], "max": [length - start, top]},
            }
            for number, (start, end, bottom, top) in enumerate(wall.openings)
        ]
        elements.append(
            {
                "id": f"wall_{row}", "type": "Wall", "points": points, "height": shell.height_m,
                "depth": THICK_M, "holes": holes, **room,
            }
        )  # fmt: skip
    walls = [f"wall_{row}" for row in range(len(shell.walls))]
    return {
        "version": "arch@1.0.2", "id": name, "coords2d": [0, 1], "scaleToMeters": 1, **_Z_UP,
        "defaults": {"Wall": {"depth": THICK_M}, "Floor": {"depth": THICK_M}},
        "elements": elements,
        "regions": [{"id": "room", "type": "Other", "walls": walls}],
    }  # fmt: skip


CLASS_FORMATS: Mapping[str, Callable[[Sequence[Scene], Path], None]] = {
    "atiss": write_atiss,
    "threed-front": write_front,
}
"""Formats that require a furniture class for each object, so that void objects are left out."""
SIMULATORS: Mapping[str, Callable[[Sequence[Scene], Path, ShellName], None]] = {
    "mujoco": _write_mujoco,
    "usd": _write_usd,
    "habitat": write_habitat,
}
"""Simulator formats; before export, objects are made stable (`core/contact_resolution.py`)."""
FORMATS = (*CLASS_FORMATS, *SIMULATORS, "sceneeval", "obj")

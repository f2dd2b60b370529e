"""Export as SceneEval's scene states, with models and walls: z up, metres."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.core.files import write_json, write_whole
from sceneprior.core.scene import Scene
from sceneprior.core.shell import THICK_M, Shell, shell_of
from sceneprior.render.appearance import node_names, scene_meshes
from sceneprior.render.scene_files import scene_to_glb

PREFIX = "sceneprior"
"""Prefix of model ids, by which SceneEval identifies a model's data set."""
Z_UP = {"up": [0, 0, 1], "front": [0, 1, 0]}


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
        columns = [1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, x, -z, y, 1]
        objects.append(
            {
                "index": index,
                "id": name,
                "modelId": f"{PREFIX}.{scene.name}_{name}",
                "parentId": "",
                "transform": {"rows": 4, "cols": 4, "data": [float(value) for value in columns]},
            }
        )
    return {
        "format": "sceneState",
        "scene": {
            "version": "scene@1.0.2", "id": scene.name, "unit": 1.0, **Z_UP,
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
        "version": "arch@1.0.2", "id": name, "coords2d": [0, 1], "scaleToMeters": 1, **Z_UP,
        "defaults": {"Wall": {"depth": THICK_M}, "Floor": {"depth": THICK_M}},
        "elements": elements,
        "regions": [{"id": "room", "type": "Other", "walls": walls}],
    }  # fmt: skip

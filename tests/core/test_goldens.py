"""Files of three fixed scenes, a shard, and a room made stable, as they were before a redesign.

Numbers in texts are rounded to a tenth of a millimetre, since the last bits differ between
processors.
"""

import hashlib
import json
import re
from pathlib import Path

import numpy as np
from golden_values import assert_as_before
from rooms_of_walls import L_SHAPE, shell_room

from sceneprior.core.contact_resolution import make_stable
from sceneprior.core.scene import Opening, Scene, SceneObject, Solid, quarter_turned
from sceneprior.core.scene_json import read_scene, scene_to_json
from sceneprior.core.shard_writing import shard_bytes
from sceneprior.core.shell import SHELLS, shell_meshes, shell_of
from sceneprior.core.wall_lines import find_walls, seen_floor
from sceneprior.render.scene_files import read_glb_parts, save
from sceneprior.render.scene_simulators import scene_to_mjcf
from sceneprior.render.topdown import floor_plan, perspective, topdown

OUTLINE = np.array([[-2.5, -2], [2.5, -2], [2.5, 0.5], [0.5, 0.5], [0.5, 2.2], [-2.5, 2.2]])


def legs(x: float, z: float) -> tuple[Solid, ...]:
    """A table's top on one leg beside its middle."""
    return (
        Solid("box", (x - 0.5, 0.7, z - 0.4), (x + 0.5, 0.75, z + 0.4)),
        Solid("cylinder", (x - 0.45, 0.02, z - 0.05), (x - 0.35, 0.7, z + 0.05)),
    )


def scenes() -> list[Scene]:
    bed = SceneObject(
        "double_bed", (0.4, 0.4, -0.3), (1.8, 0.8, 2.0), turned=quarter_turned((1.8, 0.8, 2.0), 1)
    )
    table = SceneObject("table", (-1.2, 0.385, 0.6), (1.0, 0.73, 0.8), solids=legs(-1.2, 0.6))
    lamp = SceneObject("ceiling_lamp", (0.0, 2.3, 0.0), (0.5, 0.4, 0.5))
    chair = SceneObject("chair", (-1.0, 0.5, 0.5), (0.5, 0.9, 0.5))
    openings = (
        Opening("door", (-1.0, -2.0), (-0.1, -2.0), 0.0, 2.0),
        Opening("window", (2.5, -1.5), (2.5, -0.3), 0.9, 2.1),
    )
    walled = Scene("walled", "front3d_bedroom", (bed, table, lamp, chair), OUTLINE)
    return [
        Scene("bare", "front3d_bedroom", (bed, lamp), extra={"seed": 1}),
        walled,
        Scene("open", "front3d_bedroom", (bed, table), walled.floor_m, {}, None, openings, 2.5),
    ]


def rounded(text: str) -> str:
    """The hash of a text whose numbers have four decimals, without a sign of zero."""
    numbers = re.sub(r"-?\d+\.\d+(?:e-?\d+)?", lambda m: f"{round(float(m[0]), 4) + 0.0:.4f}", text)
    return hashlib.sha256(numbers.encode()).hexdigest()[:16]


def summary(points: np.ndarray) -> list[float]:
    """Count, mean and spread of points."""
    values = np.asarray(points, dtype=np.float64)
    return [len(values), *np.concatenate([values.mean(0), values.std(0)]).round(4).tolist()]


def found(folder: Path) -> dict[str, object]:
    """Everything that is frozen, by name."""
    told: dict[str, object] = {}
    for scene in scenes():
        told[f"{scene.name} json"] = rounded(json.dumps(scene_to_json(scene)))
        told[f"{scene.name} topdown"] = topdown(scene)[::64, ::64].sum(axis=2).tolist()
        picture = perspective(scene).astype(int)
        # Whole tens: single pixels at edges may differ.
        means = picture.reshape(9, 40, 12, 40, 3).mean(axis=(1, 3, 4)) / 10
        told[f"{scene.name} picture"] = np.rint(means).tolist()
        plan = np.pad(floor_plan(scene).astype(int), ((0, 0), (0, 42), (0, 0)), mode="edge")
        means = plan.reshape(8, 64, 11, 64, 3).mean(axis=(1, 3)) / 10
        told[f"{scene.name} plan"] = np.rint(means).tolist()
        told[f"{scene.name} mjcf"] = rounded(scene_to_mjcf(scene, shell_of(scene)))
        for shell in SHELLS:
            name = f"{scene.name} {shell}"
            save(scene, folder / "a.glb", shell)
            save(scene, folder / "a.obj", shell)
            told[f"{name} obj"] = rounded((folder / "a.obj").read_text())
            told[f"{name} mtl"] = rounded((folder / "a.mtl").read_text())
            told[f"{name} shell"] = {
                key: summary(mesh.vertices_m) for key, mesh in shell_meshes(scene, shell).items()
            }
            told[f"{name} glb"] = {
                node: summary(parts[0].mesh.vertices_m)
                for node, parts in read_glb_parts(folder / "a.glb").items()
            }
        told[f"{scene.name} inside"] = {
            key: summary(mesh.vertices_m) for key, mesh in shell_of(scene).inner_meshes().items()
        }
        stable, changes, _ = make_stable(scene)
        told[f"{scene.name} stable"] = [stable.centers_m.round(4).tolist(), dict(changes)]
    room = shell_room(L_SHAPE, [(-1.0, 0.5), (-1.2, -0.8)])
    walls, doors = find_walls(room)
    told["walls"] = [np.round([w.start_m, w.end_m], 3).tolist() for w in (*walls, *doors)]
    told["floor"] = round(seen_floor(room).area, 3)
    told["shard"] = hashlib.sha256(shard_bytes("a", "front3d_bedroom", [(room, None)])).hexdigest()
    return told


def test_files_and_rooms_are_those_of_before(tmp_path):
    assert_as_before("core/files", found(tmp_path), abs=2e-3)


def test_a_scene_comes_back_from_its_files(tmp_path):
    for scene in scenes():
        save(scene, tmp_path / "a.json")
        back = read_scene(tmp_path / "a.json")
        assert scene_to_json(back) == scene_to_json(scene)

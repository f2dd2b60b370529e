"""Damaged scenes, box lists and meshes: every mutation is read, or refused in one sentence.

Each function below makes one mutation in a folder, whose name is its seed, and reads it.
"""

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mutating import MUTATIONS, assert_one_sentence, damaged_bytes, damaged_json, damaged_words

CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 2)]
FACES = [(1, 2, 4), (1, 4, 3), (5, 8, 6), (5, 7, 8), (1, 3, 7), (2, 6, 8)]


def begun(folder: Path) -> np.random.Generator:
    (folder / "given").mkdir()
    return np.random.default_rng(int(folder.name))


def example() -> Any:
    from sceneprior.core.scene import Scene, SceneObject, Turned
    from sceneprior.render.appearance import box_mesh

    bed = SceneObject("double_bed", (0.0, 0.3, -0.5), (1.8, 0.6, 2.0))
    turned = Turned(np.pi / 2, (1.2, 0.8, 0.6))
    desk = SceneObject("desk", (1.5, 0.4, 1.0), (0.6, 0.8, 1.2), turned=turned)
    floor = np.array([[-2.0, -2], [2, -2], [2, 2], [-2, 2]])
    meshed = tuple(
        SceneObject(o.label, o.center_m, o.size_m, box_mesh(o.center_m, o.size_m), o.turned)
        for o in (bed, desk)
    )
    return Scene("mine", "front3d_bedroom", meshed, floor, {"seed": 1})


def use_scenes(scenes: list, folder: Path) -> None:
    """Draw and write what could be read, in each format."""
    from sceneprior.interchange.export import export_scenes
    from sceneprior.render.scene_files import load_scene, save
    from sceneprior.render.topdown import TopDownProtocol, perspective, topdown

    for scene in scenes:
        topdown(scene, TopDownProtocol((32, 32)))
        perspective(scene, (24, 32))
        for ending in (".json", ".glb", ".obj"):
            save(scene, folder / f"again{ending}")
        load_scene(folder / "again.json")
    for to in ("atiss", "threed-front"):
        export_scenes(scenes, to, folder / to)


def fuzz_json(folder: Path) -> None:
    from sceneprior.core.scene_json import scene_to_json
    from sceneprior.render.scene_files import load_scene_folder

    rng, data, path = begun(folder), scene_to_json(example()), folder / "given" / "room.json"
    if rng.random() < 0.8:
        path.write_text(damaged_json(data, rng))
    else:
        path.write_bytes(damaged_bytes(json.dumps(data).encode(), rng))
    use_scenes(load_scene_folder(path.parent), folder)


def fuzz_glb(folder: Path) -> None:
    from sceneprior.render.scene_files import load_scene_folder, save, scene_to_glb

    rng = begun(folder)
    save(example(), folder / "given" / "room.json")
    glb = scene_to_glb(example())
    length = struct.unpack("<I", glb[12:16])[0]
    text, binary = glb[20 : 20 + length], glb[20 + length :]
    how = rng.integers(3)
    if how == 0:
        text = damaged_json(json.loads(text), rng).encode()
    elif how == 1:
        binary = binary[:8] + damaged_bytes(binary[8:], rng)
    text += b" " * (-len(text) % 4)
    head = struct.pack("<5I", 0x46546C67, 2, 20 + len(text) + len(binary), len(text), 0x4E4F534A)
    glb = head + text + binary
    (folder / "given" / "room.glb").write_bytes(damaged_bytes(glb, rng) if how == 2 else glb)
    use_scenes(load_scene_folder(folder / "given"), folder)


def fuzz_npz(folder: Path) -> None:
    from sceneprior.interchange.box_lists import read_box_lists
    from sceneprior.interchange.export import export_scenes

    rng = begun(folder)
    export_scenes([example()], "atiss", folder / "given")
    path = folder / "given" / "mine" / "boxes.npz"
    with np.load(path) as file:
        arrays = dict(file)
    if rng.random() < 0.4:
        path.write_bytes(damaged_bytes(path.read_bytes(), rng))
    elif rng.random() < 0.5:
        plain = {key: array.tolist() for key, array in arrays.items()}
        path.with_suffix(".json").write_text(damaged_json(plain, rng))
        path.unlink()
    else:
        key = list(arrays)[rng.integers(len(arrays))]
        changed = (
            lambda a: a[:1], lambda a: a[..., :0], lambda a: a[:0], lambda a: a[None],
            lambda a: a.astype(str), lambda a: a.astype(complex), lambda a: a * np.nan,
            lambda a: a * 1e308 * 10, lambda a: a * 100, lambda a: -a, lambda a: a.ravel(),
            lambda a: a.astype(bool), lambda a: a.sum(), lambda a: a.astype("datetime64[s]"),
            lambda a: np.repeat(a, 20000, axis=0), lambda a: a.astype(np.int64) + 2**40,
        )  # fmt: skip
        arrays[key] = changed[rng.integers(len(changed))](arrays[key].astype(float))
        if rng.random() < 0.1:
            del arrays[key]
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)
        path.write_bytes(buffer.getvalue())
    use_scenes(read_box_lists(folder / "given", "front3d_bedroom"), folder)


OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "".join(
    f"f {a}/1 {b}/2 {c}\n" for a, b, c in FACES
)


def fuzz_ply(folder: Path) -> None:
    from sceneprior.core.ground_truth import read_model

    rng, path = begun(folder), folder / "given" / "a.ply"
    ply = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\n"
    ply += "property float z\nelement face 6\nproperty list uchar int vertex_indices\nend_header\n"
    ply += "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS)
    ply += "".join(f"3 {a - 1} {b - 1} {c - 1}\n" for a, b, c in FACES)
    path.write_bytes(damaged_words(ply, rng))
    read_model(path)


def fuzz_models(folder: Path) -> None:
    from sceneprior.apps.retrieval.cad_models import open_models

    rng = begun(folder)
    (folder / "given" / "a").mkdir()
    record = [{"model_id": "a", "category": "Wardrobe"}]
    listed = damaged_json(record, rng) if rng.random() < 0.5 else json.dumps(record)
    (folder / "given" / "a" / "raw_model.obj").write_bytes(damaged_words(OBJ, rng))
    (folder / "given" / "model_info.json").write_text(listed)
    open_models(folder / "given", "front3d_bedroom", folder / "cache")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["json", "glb", "npz", "ply", "models"])
def test_damaged_files_are_refused_in_a_sentence(name, tmp_path):
    paths = [tmp_path / str(seed) for seed in range(MUTATIONS)]
    for path in paths:
        path.mkdir()
    said = assert_one_sentence(__file__, f"fuzz_{name}", paths)
    # Many are damaged enough to notice, and the others are read and written again.
    assert MUTATIONS // 10 < sum(map(bool, said)) < MUTATIONS

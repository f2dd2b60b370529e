"""Damaged scenes, box lists and meshes: every mutation is read, or refused in one sentence.

Each format runs in a process of its own, which a crash ends without the tests; it prints what it is
at, so a failure names the mutation, and `python tests/fuzz/test_scene_files.py FORMAT FOLDER ROW`
repeats it.
"""

import copy
import io
import json
import os
import random
import resource
import signal
import struct
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
MUTATIONS = 300
SECONDS = 120
"""One mutation; the machine may be busy."""
MOST_BYTES = 2 * 2**30

ODD: tuple[Any, ...] = (
    None, True, False, "", "1.0", "wardrobe", -1, 0, 1, 3, 2**31, 2**63, 10**400, 1e308, -1e308,
    float("nan"), float("inf"), 180.0, 1e-320, [], {}, [[]], [1.0], [1.0, 2.0, 3.0], "\ud800",
    "a/b", "x" * 5000, ["desk"] * 3, {"class": "desk"},
)  # fmt: skip

DEEP = "@deep"


def places(data: Any, before: tuple = ()) -> list[tuple]:
    """The paths of all values in a JSON."""
    keys: Any = ()
    if isinstance(data, dict | list):
        keys = data if isinstance(data, dict) else range(len(data))
    return [before, *(place for key in keys for place in places(data[key], (*before, key)))]


def change_json(data: Any, rng: random.Random) -> Any:
    """Values replaced, deleted, repeated or nested deeply, at random places."""
    data = copy.deepcopy(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        *way, last = rng.choice([place for place in places(data) if place] or [(None,)])
        if last is None:
            return rng.choice(ODD)
        holder = data
        for key in way:
            holder = holder[key]
        how = rng.randrange(6)
        if how == 0:
            del holder[last]
        elif how == 1 and isinstance(holder, list):
            holder += [copy.deepcopy(holder[last]) for _ in range(rng.choice((1, 3, 20000)))]
        elif how == 2:
            holder[last] = DEEP
        elif how == 3 and isinstance(holder[last], int | float):
            holder[last] = holder[last] * rng.choice((-1, 100, 1000, 1e9, 1e300, 0))
        else:
            holder[last] = copy.deepcopy(rng.choice(ODD))
    return data


def json_of(data: Any, rng: random.Random) -> str:
    """JSON, with deep lists or objects where `DEEP` stands."""
    depth = rng.choice((5, 300, 900, 3000, 100_000))
    opened, closed = rng.choice((("[", "]"), ('{"a":', "}")))
    return json.dumps(data).replace(f'"{DEEP}"', opened * depth + "1" + closed * depth, 1)


def change_bytes(data: bytes, rng: random.Random) -> bytes:
    """Bytes flipped, cut off, repeated, or overwritten with large numbers."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 2, 8))):
        at = rng.randrange(max(len(out), 1))
        how = rng.randrange(5)
        if how == 0 and out:
            out[at] = rng.randrange(256)
        elif how == 1:
            out[at : at + 4] = struct.pack("<I", rng.choice((0, 1, 2**31, 2**32 - 1, 70000)))
        elif how == 2:
            out[at : at + 4] = struct.pack("<f", rng.choice((np.nan, np.inf, 1e38, -1e30)))
        elif how == 3:
            out[at:at] = out[max(0, at - 40) : at]
        elif rng.random() < 0.3:
            del out[at:]
    return bytes(out)


def example() -> Any:
    from sceneprior.core.scene import Scene, SceneObject, Turned
    from sceneprior.render.topdown import box_mesh

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
    from sceneprior.render.offscreen import SoftwareRenderer
    from sceneprior.render.scene_files import load_scene, save_scene
    from sceneprior.render.topdown import TopDownProtocol, perspective, topdown

    for scene in scenes:
        topdown(scene, SoftwareRenderer(), TopDownProtocol((32, 32)))
        perspective(scene, SoftwareRenderer(), (24, 32))
        for ending in (".json", ".glb", ".obj"):
            save_scene(scene, folder / f"again{ending}")
        load_scene(folder / "again.json")
    for to in ("atiss", "threed-front"):
        export_scenes(scenes, to, folder / to)


def fuzz_json(folder: Path, rng: random.Random) -> None:
    from sceneprior.core.scene import scene_to_json
    from sceneprior.render.scene_files import load_scene_folder

    data, path = scene_to_json(example()), folder / "given" / "room.json"
    if rng.random() < 0.8:
        path.write_text(json_of(change_json(data, rng), rng))
    else:
        path.write_bytes(change_bytes(json.dumps(data).encode(), rng))
    use_scenes(load_scene_folder(path.parent), folder)


def fuzz_glb(folder: Path, rng: random.Random) -> None:
    from sceneprior.render.scene_files import load_scene_folder, save_scene, scene_to_glb

    save_scene(example(), folder / "given" / "room.json")
    glb = scene_to_glb(example())
    length = struct.unpack("<I", glb[12:16])[0]
    text, binary = glb[20 : 20 + length], glb[20 + length :]
    how = rng.randrange(3)
    if how == 0:
        text = json_of(change_json(json.loads(text), rng), rng).encode()
    elif how == 1:
        binary = binary[:8] + change_bytes(binary[8:], rng)
    text += b" " * (-len(text) % 4)
    head = struct.pack("<5I", 0x46546C67, 2, 20 + len(text) + len(binary), len(text), 0x4E4F534A)
    glb = head + text + binary
    (folder / "given" / "room.glb").write_bytes(change_bytes(glb, rng) if how == 2 else glb)
    use_scenes(load_scene_folder(folder / "given"), folder)


def fuzz_npz(folder: Path, rng: random.Random) -> None:
    from sceneprior.interchange.box_lists import read_box_lists
    from sceneprior.interchange.export import export_scenes

    export_scenes([example()], "atiss", folder / "given")
    path = folder / "given" / "mine" / "boxes.npz"
    with np.load(path) as file:
        arrays = dict(file)
    if rng.random() < 0.4:
        path.write_bytes(change_bytes(path.read_bytes(), rng))
    elif rng.random() < 0.5:
        plain = {key: array.tolist() for key, array in arrays.items()}
        path.with_suffix(".json").write_text(json_of(change_json(plain, rng), rng))
        path.unlink()
    else:
        for _ in range(rng.choice((1, 2))):
            key = rng.choice(list(arrays))
            array = arrays[key]
            changed = (
                lambda a: a[:1], lambda a: a[..., :0], lambda a: a[:0], lambda a: a[None],
                lambda a: a.astype(str), lambda a: a.astype(complex), lambda a: a * np.nan,
                lambda a: a * 1e308 * 10, lambda a: a * 100, lambda a: -a, lambda a: a.ravel(),
                lambda a: a.astype(bool), lambda a: a.sum(), lambda a: a.astype("datetime64[s]"),
                lambda a: np.repeat(a, 20000, axis=0), lambda a: a.astype(np.int64) + 2**40,
            )  # fmt: skip
            arrays[key] = rng.choice(changed)(np.asarray(array, dtype=float))
            if rng.random() < 0.1:
                del arrays[key]
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)
        path.write_bytes(buffer.getvalue())
    use_scenes(read_box_lists(folder / "given", "front3d_bedroom"), folder)


def fuzz_models(folder: Path, rng: random.Random) -> None:
    from sceneprior.apps.retrieval.cad_models import open_models
    from sceneprior.core.furniture import read_obj
    from sceneprior.core.ground_truth import read_model

    read_model.cache_clear()
    model = folder / "given" / "a" / "raw_model.obj"
    model.parent.mkdir()
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 2)]
    faces = [(1, 2, 4), (1, 4, 3), (5, 8, 6), (5, 7, 8), (1, 3, 7), (2, 6, 8)]
    obj = "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
    obj += "".join(f"f {a}/1 {b}/2 {c}\n" for a, b, c in faces)
    ply = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\n"
    ply += "property float z\nelement face 6\nproperty list uchar int vertex_indices\nend_header\n"
    ply += "".join(f"{x} {y} {z}\n" for x, y, z in corners)
    ply += "".join(f"3 {a - 1} {b - 1} {c - 1}\n" for a, b, c in faces)
    numbers = ("99", "-9", "0", "nan", "1e999", "x", "-1", "99999999999999999999", "")
    for name, text, read in ((model.name, obj, read_obj), ("a.ply", ply, read_model)):
        data = text.encode()
        if rng.random() < 0.5:
            words = text.split(" ")
            words[rng.randrange(len(words))] = rng.choice(numbers)
            data = " ".join(words).encode()
        else:
            data = change_bytes(data, rng)
        (model.parent / name).write_bytes(data)
        refused(partial(read, model.parent / name))
    record = [{"model_id": "a", "category": "Wardrobe"}]
    if rng.random() < 0.3:
        record = change_json(record, rng)
    (folder / "given" / "model_info.json").write_text(json_of(record, rng))
    open_models(folder / "given", "front3d_bedroom", folder / "cache", 16)


FORMATS: dict[str, Callable[[Path, random.Random], None]] = {
    "json": fuzz_json, "glb": fuzz_glb, "npz": fuzz_npz, "models": fuzz_models,
}  # fmt: skip


def refused(act: Callable[[], object]) -> bool:
    """Whether an act is refused in a sentence, short enough to read; any other error is raised."""
    from sceneprior.core.errors import InputError

    try:
        act()
    except InputError as error:
        said = str(error)
        assert said and len(said) < 2000 and "Traceback" not in said, said[:3000]
        return True
    return False


def main(name: str, folder: Path, *rows: str) -> None:
    """Run all mutations of a format, or some rows of them."""
    import shutil

    def hang(*_: object) -> None:
        raise TimeoutError(f"longer than {SECONDS} s")

    signal.signal(signal.SIGALRM, hang)
    count = 0
    for row in map(int, rows) if rows else range(MUTATIONS):
        print(f"{name} {row}", flush=True)
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "given").mkdir(parents=True)
        signal.alarm(SECONDS)
        count += refused(lambda row=row: FORMATS[name](folder, random.Random(f"{name} {row}")))
        signal.alarm(0)
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        assert most < MOST_BYTES, f"{most / 2**30:.1f} GiB"
    print(f"refused {count}", flush=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_refused_in_a_sentence(name, tmp_path):
    ended = subprocess.run(
        [sys.executable, __file__, name, str(tmp_path / "work")],
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, timeout=3600,
    )  # fmt: skip
    *_, last = ended.stdout.splitlines()
    assert ended.returncode == 0, f"{last} ended with {ended.returncode}: {ended.stderr[-3000:]}"
    # Many are damaged enough to notice, and the others are read and written again.
    assert MUTATIONS // 10 < int(last.removeprefix("refused ")) < MUTATIONS


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])

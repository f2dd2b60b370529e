"""Damaged captures: each gives rooms or one sentence, in time and memory; never a raw error.

Seeded mutations of files in the formats that users bring, 300 a format. A failure prints its case,
which is the seed of what was damaged.
"""

import contextlib
import json
import resource
import signal
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from capture_files import timestamp
from front_files import FrontFolder, bedroom
from mutating import MUTATIONS, damaged_json
from pycocotools.mask import encode
from toy_formats import FORMATS

from data_prep.engine.source import pool
from data_prep.front.furnished import ModelBank
from data_prep.front.houses import read_house
from data_prep.front.recipe import broken_rule, load_recipe
from data_prep.readers.posed.reader import Posed
from sceneprior.core.coco import read_coco
from sceneprior.core.errors import InputError

pytestmark = pytest.mark.slow

SECONDS = 60
"""A case takes milliseconds; machines that tests share may be slow."""
MEMORY = 2 << 30

WORDS = ["", "x", "nan", "inf", "-1", "0", "1e999", "9" * 400, "1.5", "\ufffd", "#", "= =", "\0"]


def damaged_text(text: str, rng: np.random.Generator) -> str:
    """Up to three words: another there, or gone; or lines gone, doubled or cut off."""
    lines = text.split("\n")
    for _ in range(rng.integers(1, 4)):
        at = rng.integers(len(lines))
        words = lines[at].split(" ")
        action = rng.random()
        if action < 0.7:
            words[rng.integers(len(words))] = WORDS[rng.integers(len(WORDS))]
            lines[at] = " ".join(words)
        elif action < 0.8:
            lines[at] = lines[at][: rng.integers(len(lines[at]) + 1)]
        elif action < 0.9:
            lines.insert(at, lines[at])
        else:
            del lines[at]
            lines = lines or [""]
    return "\n".join(lines)


def damaged_bytes(data: bytes, rng: np.random.Generator, first: int) -> bytes:
    """Up to four numbers among the first bytes are others, or the end is gone."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(first - 8))
        value = [b"\xff", b"\0\0\0\0", b"\xff" * 8, struct.pack("<f", np.nan), rng.bytes(4),
                 struct.pack("<f", 1e30), struct.pack("<Q", 1 << 40)][rng.integers(7)]  # fmt: skip
        changed[at : at + len(value)] = value
    return bytes(changed[: rng.integers(len(changed))] if rng.random() < 0.2 else changed)


@contextlib.contextmanager
def limits() -> Iterator[None]:
    """2 GB more than there is now, and a minute: what needs more ends with an error."""

    def too_long(*_: object) -> None:
        raise AssertionError(f"it hangs: more than {SECONDS} s")

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before = signal.signal(signal.SIGALRM, too_long)
    resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + MEMORY, hard))
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def check_all(damage: Callable[[np.random.Generator], None], read: Callable[[], object]) -> None:
    """Damage and read `MUTATIONS` times; an error is the package's own, in one sentence or two."""
    refused = 0
    for case in range(MUTATIONS):
        damage(np.random.default_rng(case))
        try:
            with limits():
                read()
        except InputError as error:
            refused += 1
            text = str(error)
            assert text.isprintable() and len(text) < 1200, (case, text[:2000])
        except BaseException:
            print("case", case)
            raise
    # Mutations that all fail, or all pass, test nothing.
    assert 0.1 * MUTATIONS < refused < MUTATIONS


JSONS = {
    "transforms": "attic/transforms.json",
    "opencv": "attic/transforms.json",
    "transforms, small": "attic/classes.json",
    "polycam": f"attic/keyframes/corrected_cameras/{timestamp(1)}.json",
    "record3d": "attic/metadata",
    "grounded-sam2": "attic/json_data/mask_frame_00001.json",
    "grounded-sam2, images": "attic/json_data/results_1.json",
    "coco": "attic/coco.json",
    "coco, tracks": "attic/coco.json",
    "coco, video": "attic/instances.json",
    "panoptic": "attic/panoptic.json",
    "scannet": "scans/scene0000_00/scene0000_00.aggregation.json",
    "scannet, small": "scans/scene0000_00/scene0000_00_vh_clean_2.0.010000.segs.json",
}
SCAN = "scans/scene0000_00/scene0000_00"
BYTES = {
    "transforms": [("attic/instances/frame_00001.png", 1000)],
    "sam2": [("attic/003/frame_00001.png", 200), ("attic/007/frame_00001.png", 30)],
    "grounded-sam2": [("attic/mask_data/mask_frame_00001.npy", 200)],
    "colmap": [("attic/sparse/0/images.bin", 1000)],
    "scannet": [(f"{SCAN}.sens", 450)],
    "scannet, small": [(f"{SCAN}_2d-instance-filt.zip", 10_000), (f"{SCAN}_vh_clean_2.ply", 1000)],
}
"""Files of a format, of which one is damaged, and how many of their first bytes may be."""
TEXTS = {
    "colmap, text": "attic/sparse/0/images.txt",
    "colmap, cameras": "attic/sparse/0/cameras.txt",
    "scannet": "scans/scene0000_00/scene0000_00.txt",
}
SAME = {"scannet, small": "scannet", "colmap, cameras": "colmap, text"}


@pytest.fixture
def reading(tmp_path):
    """Writes a format's toy room, and returns how it is read."""

    def written(name: str) -> Callable[[], None]:
        source = FORMATS[SAME.get(name, name)](tmp_path).source
        with pool(1) as run:
            (task,) = source.survey(run).rooms

        def read() -> None:
            if isinstance(source, Posed):
                source.found()
                source.assumptions()
            source.settings(None)
            source.rooms(task.house)
            source.prepare(task, None)

        read()
        return read

    return written


@pytest.mark.parametrize("name", JSONS)
def test_json_of_each_format(reading, tmp_path, name):
    read, path = reading(name), tmp_path / JSONS[name]
    data = json.loads(path.read_text())
    check_all(lambda rng: path.write_text(damaged_json(data, rng)), read)


@pytest.mark.parametrize("name", BYTES)
def test_binary_files_of_each_format(reading, tmp_path, name):
    read = reading(name)
    files = [(tmp_path / inside, (tmp_path / inside).read_bytes(), n) for inside, n in BYTES[name]]

    def damage(rng: np.random.Generator) -> None:
        chosen = rng.integers(len(files))
        for k, (path, data, first) in enumerate(files):
            first = min(first, len(data))
            path.write_bytes(damaged_bytes(data, rng, first) if k == chosen else data)

    check_all(damage, read)


@pytest.mark.parametrize("name", TEXTS)
def test_texts_of_each_format(reading, tmp_path, name):
    read, path = reading(name), tmp_path / TEXTS[name]
    text = path.read_text()
    check_all(lambda rng: path.write_text(damaged_text(text, rng)), read)


def test_coco_json(tmp_path):
    path = tmp_path / "a.json"
    packed = encode(np.asfortranarray(np.eye(30, 40, dtype=np.uint8)))
    rows = [
        {"id": 1, "image_id": 1, "category_id": 1, "segmentation": [[1, 1, 9, 1, 9, 9]]},
        {"id": 2, "image_id": 1, "category_id": 2, "iscrowd": 1,
         "segmentation": {"size": [30, 40], "counts": [100, 50, 1050]}},
        {"id": 3, "image_id": 1, "category_id": 2, "bbox": [1, 2, 3, 4],
         "segmentation": {"size": [30, 40], "counts": packed["counts"].decode()}},
    ]  # fmt: skip
    data = {
        "images": [{"id": 1, "height": 30, "width": 40}],
        "categories": [{"id": 1, "name": "bed"}, {"id": 2, "name": "chair"}],
        "annotations": rows[:2],
    }
    check_all(lambda rng: path.write_text(damaged_json(data, rng)), lambda: read_coco(path))
    data["annotations"] = rows
    check_all(lambda rng: path.write_text(damaged_json(data, rng)), lambda: read_coco(path))


def test_front_house_json(tmp_path):
    front = FrontFolder(tmp_path)
    for jid, category in (("bed", "King-size Bed"), ("stand", "Nightstand"), ("lamp", None)):
        front.model(jid, category, (0.5, 0.6, 0.4))
    path = front.house("house", bedroom("A"), bedroom("B", bounds=(3.0, -2.0, 7.0, 2.0)))
    data = json.loads(path.read_text())
    data["furniture"][0] |= {"bbox": [1.8, 1.0, 2.0], "category": "King-size Bed"}
    data["furniture"][1] |= {"jid": "gone", "category": "Nightstand"}
    bank, recipe = ModelBank(front.future), load_recipe("bedroom")
    atiss = load_recipe("atiss_bedroom")

    def read():
        found = read_house(path, bank, recipe)
        reasons = [line.reason for line in found.left_out]
        for one in found.rooms:
            for rules in (recipe, atiss):
                reasons += [broken[1]] if (broken := broken_rule(one, rules)) else []
        assert all(why.isprintable() and len(why) < 500 for why in reasons), reasons

    damage = lambda rng: Path(path).write_text(damaged_json(data, rng))  # noqa: E731
    check_all(damage, read)

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

import capture_files as tools
import numpy as np
import psutil
import pytest
from front_files import FrontFolder, bedroom
from mutating import MUTATIONS, damaged_json
from posed_files import PosedRoom
from pycocotools.mask import encode
from scan_files import make_scan, write_table
from scipy.spatial.transform import Rotation

from data_prep.front.furnished import broken_rule
from data_prep.front.houses import read_house
from data_prep.front.models import ModelBank
from data_prep.front.recipe import load_recipe
from data_prep.readers.posed.source import PosedSource
from data_prep.readers.posed.views import PosedSettings, prepare_posed
from data_prep.readers.scannet.labels import read_labels
from data_prep.readers.scannet.scans import ScanSettings, read_scan
from data_prep.readers.scannet.views import prepare_scan
from sceneprior.core.coco import read_coco
from sceneprior.core.errors import InputError

pytestmark = pytest.mark.slow

SECONDS = 60
"""A case takes milliseconds; machines that tests share may be slow."""
MEMORY = 2 << 30
LABELS = "void,bed,chair"

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


@pytest.fixture
def room(tmp_path):
    """A posed room on disk, and how it is read."""
    made = PosedRoom(tmp_path / "rooms" / "a")
    made.write(floor_m=0.0, floor_center_m=[0.1, -0.2], metres_per_unit=1.0, camera_angle_x=1.2)

    def read():
        source = PosedSource(tmp_path / "rooms", LABELS)
        source.found()
        source.assumptions()
        source.settings(None)
        prepare_posed(*source.open(made.folder), PosedSettings())

    read()
    return made, read


def test_transforms_json(room):
    made, read = room
    path = made.folder / "transforms.json"
    data = json.loads(path.read_text())
    data["frames"][0] |= {"mask_path": "instances/frame_00000.png", "fl_x": 80.0, "k1": 0.01}
    check_all(lambda rng: path.write_text(damaged_json(data, rng)), read)


def test_classes_json(room):
    made, read = room
    path = made.folder / "classes.json"
    data = json.loads(path.read_text())
    check_all(lambda rng: path.write_text(damaged_json(data, rng)), read)


def test_instance_pngs(room):
    made, read = room
    path = made.png(1)
    data = path.read_bytes()
    check_all(lambda rng: path.write_bytes(damaged_bytes(data, rng, len(data))), read)


def test_colmap_text(room):
    made, read = room
    (made.folder / "transforms.json").unlink()
    model = made.folder / "sparse" / "0"
    model.mkdir(parents=True)
    lines = []
    for k, pose in enumerate(made.poses):
        camera = np.linalg.inv(pose @ np.diag([1.0, -1, -1, 1]))
        x, y, z, w = Rotation.from_matrix(camera[:3, :3]).as_quat()
        numbers = " ".join(f"{value:.9f}" for value in (w, x, y, z, *camera[:3, 3]))
        lines += [f"{k + 1} {numbers} 1 frame_{k:05d}.jpg", "1.0 2.0 -1"]
    height, width = made.size
    texts = {
        "cameras": f"# of one camera\n1 OPENCV {width} {height} 80 80 64 48 0.01 0 0 0\n",
        "images": "# two lines an image\n" + "\n".join(lines) + "\n",
    }

    def damage(rng):
        for name, text in texts.items():
            changed = damaged_text(text, rng) if rng.random() < 0.6 else text
            (model / f"{name}.txt").write_text(changed)

    check_all(damage, read)


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


JSONS = {
    "polycam": (tools.write_polycam, f"keyframes/corrected_cameras/{tools.timestamp(1)}.json"),
    "record3d": (lambda room: tools.write_record3d(room, per_frame=True), "metadata"),
    "grounded-sam2": (tools.write_grounded_sam2, "json_data/mask_frame_00001.json"),
    "grounded-sam2 images": (tools.write_grounded_sam2_images, "json_data/results_1.json"),
    "coco images": (tools.write_coco_images, "coco.json"),
    "coco tracks": (lambda room: tools.write_coco_images(room, "track_id"), "coco.json"),
    "coco video": (tools.write_coco_video, "instances.json"),
}
MASKS = {
    "sam2": (tools.write_sam2, "003/frame_00001.png"),
    "grounded-sam2": (tools.write_grounded_sam2, "mask_data/mask_frame_00001.npy"),
}


@pytest.mark.parametrize("tool", JSONS)
def test_jsons_of_other_tools(room, tool):
    made, read = room
    write, name = JSONS[tool]
    write(made)
    data = json.loads((made.folder / name).read_text())
    check_all(lambda rng: (made.folder / name).write_text(damaged_json(data, rng)), read)


@pytest.mark.parametrize("tool", MASKS)
def test_masks_of_other_tools(room, tool):
    made, read = room
    write, name = MASKS[tool]
    write(made)
    data = (made.folder / name).read_bytes()
    check_all(lambda rng: (made.folder / name).write_bytes(damaged_bytes(data, rng, 200)), read)


@pytest.fixture
def scan(tmp_path):
    """A scan on disk, small, and how it is read."""
    made = make_scan(tmp_path / "scene0000_00").write(mask_size=(121, 162))
    labels = read_labels(write_table(tmp_path / "labels.tsv"))
    settings = ScanSettings(frame_step=1, image_size=(121, 162))

    def read():
        prepare_scan(read_scan(made.folder, labels, settings))

    read()
    return made, read


@pytest.mark.parametrize("ending", [".aggregation.json", "_vh_clean_2.0.010000.segs.json"])
def test_scannet_json(scan, ending):
    made, read = scan
    path = made.path(ending)
    data = json.loads(path.read_text())
    check_all(lambda rng: path.write_text(damaged_json(data, rng)), read)


def test_scannet_text(scan):
    made, read = scan
    path = made.path(".txt")
    text = path.read_text()
    check_all(lambda rng: path.write_text(damaged_text(text, rng)), read)


def test_scannet_sens(scan):
    made, read = scan
    path = made.path(".sens")
    data = path.read_bytes()
    check_all(lambda rng: path.write_bytes(damaged_bytes(data, rng, 450)), read)


def test_scannet_masks_and_mesh(scan):
    made, read = scan
    paths = [made.path("_2d-instance-filt.zip"), made.path("_vh_clean_2.ply")]
    texts = [path.read_bytes() for path in paths]

    def damage(rng):
        chosen = rng.integers(2)
        for k, (path, data) in enumerate(zip(paths, texts, strict=True)):
            path.write_bytes(damaged_bytes(data, rng, len(data)) if k == chosen else data)

    check_all(damage, read)


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

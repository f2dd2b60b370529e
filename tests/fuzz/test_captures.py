"""Damaged captures: each gives rooms or one sentence, in time and memory; never a raw error.

Seeded mutations of files in the formats that users bring, 300 a format. A failure prints its case,
which is the seed of what was damaged.
"""

import contextlib
import json
import resource
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from capture_files import timestamp
from front_files import FrontFolder, bedroom
from mutating import MUTATIONS, damaged_bytes, damaged_json, damaged_words
from toy_formats import FORMATS

from data_prep.engine.source import pool
from data_prep.front.furnished import ModelBank
from data_prep.front.houses import read_house
from data_prep.front.recipe import broken_rule, load_recipe
from data_prep.readers.posed.reader import Posed
from sceneprior.core.errors import InputError

pytestmark = pytest.mark.slow

SECONDS = 60
"""A case takes milliseconds; machines that tests share may be slow."""
MEMORY = 2 << 30


def damaged(path: Path, whole: bytes, rng: np.random.Generator) -> bytes:
    """The contents of a file, damaged as its type suggests."""
    if path.suffix in (".json", ""):
        return damaged_json(json.loads(whole), rng).encode()
    if path.suffix in (".txt", ".csv"):
        return damaged_words(whole.decode(), rng)
    return damaged_bytes(whole, rng)


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


def check_all(damage: Callable[[np.random.Generator], object], read: Callable[[], object]) -> None:
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


SCAN = "scans/scene0000_00/scene0000_00"
SCENE, VIEWS = "ai_001_002", "scene_00007/2D_rendering/480/perspective/full"
FILES = {
    "transforms": ["transforms.json", "classes.json", "instances/frame_00001.png"],
    "opencv": ["transforms.json"],
    "colmap": ["sparse/0/images.bin", "sparse/0/cameras.bin"],
    "colmap, text": ["sparse/0/images.txt", "sparse/0/cameras.txt"],
    "polycam": [f"keyframes/corrected_cameras/{timestamp(1)}.json"],
    "record3d": ["metadata"],
    "sam2": ["003/frame_00001.png"],
    "grounded-sam2": ["json_data/mask_frame_00001.json", "mask_data/mask_frame_00001.npy"],
    "grounded-sam2, images": ["json_data/results_1.json"],
    "coco": ["coco.json"],
    "coco, tracks": ["coco.json"],
    "coco, video": ["instances.json"],
    "panoptic": ["panoptic.json"],
    "scannet": [f"{SCAN}{ending}" for ending in (
        ".sens", ".txt", ".aggregation.json", "_vh_clean_2.0.010000.segs.json",
        "_2d-instance-filt.zip", "_vh_clean_2.ply",
    )],
    "blenderproc": ["model_info.json", "house/1.hdf5", "cam_K.npy"],
    "hypersim": ["metadata_camera_parameters.csv", f"{SCENE}/_detail/metadata_scene.csv",
                 f"{SCENE}/_detail/cam_00/camera_keyframe_positions.hdf5"],
    "structured3d": ["scene_00007/annotation_3d.json", "scene_00007/bbox_3d.json",
                     f"{VIEWS}/0/camera_pose.txt", f"{VIEWS}/1/semantic.png"],
    "scannetpp": ["0a5c01/dslr/nerfstudio/transforms.json", "0a5c01/scans/segments_anno.json"],
    "scannetpp, iphone": ["0a5c01/iphone/pose_intrinsic_imu.json"],
}  # fmt: skip
"""Files of each format that are damaged; those of posed rooms are in `attic`."""


@pytest.mark.parametrize(
    ("name", "file"), [(k, file) for k, files in FILES.items() for file in files]
)
def test_damaged_files_of_each_format(tmp_path, name, file):
    source = FORMATS[name](tmp_path).source
    path = tmp_path / ("attic" if isinstance(source, Posed) else "") / file
    whole = path.read_bytes()
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
    check_all(lambda rng: path.write_bytes(damaged(path, whole, rng)), read)


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

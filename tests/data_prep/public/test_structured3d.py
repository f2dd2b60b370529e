"""Structured3D's damaged or foreign files, and floors that do not close."""

import json

import numpy as np
import pytest
from PIL import Image
from public_files import furnished, write_structured3d

from data_prep.engine.workers import pool
from data_prep.readers.source import PublicSource, open_reader
from sceneprior.core.errors import InputError

VIEW = "2D_rendering/480/perspective/full/0"


@pytest.fixture
def scene(tmp_path):
    write_structured3d(tmp_path / "s3d", "scene_00007", "480", furnished(tmp_path))
    return tmp_path / "s3d" / "scene_00007"


def read(scene):
    source = PublicSource(open_reader("structured3d", scene.parent))
    with pool(1) as run:
        (task,) = source.survey(run).rooms
    return source.prepare(task, None)


def change(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


GOOD = "0 0 1000 1 0 0 0 0 1"
DAMAGE = {
    "a truncated pose": (
        lambda s: (s / VIEW / "camera_pose.txt").write_text("1 2 3"), r"does not hold 12 numbers",
    ),
    "angles in degrees": (
        lambda s: (s / VIEW / "camera_pose.txt").write_text(f"{GOOD} 40 30 1"),
        r"half angles \[40.0, 30.0\], are those of no camera",
    ),
    "a tiny angle": (
        lambda s: (s / VIEW / "camera_pose.txt").write_text(f"{GOOD} 0.01 0.01 1"),
        r"camera_pose.txt: a focal length of",
    ),
    "another size": (
        lambda s: Image.new("L", (20, 10)).save(s / VIEW / "semantic.png"),
        r"semantic.png has 20 x 10 pixels, but the room's first view 128 x 96",
    ),
    "colours": (
        lambda s: Image.new("RGB", (128, 96)).save(s / VIEW / "semantic.png"),
        r"semantic.png is 8-bit RGB; expected one channel",
    ),
    "truncated boxes": (
        lambda s: (s / "bbox_3d.json").write_text("[{"), r"bbox_3d.json is not JSON",
    ),
    "foreign boxes": (
        lambda s: (s / "bbox_3d.json").write_text('[{"id": 1}]'), r"bbox_3d.json: 0.ID is",
    ),
    "no structure": (
        lambda s: (s / "annotation_3d.json").unlink(), r"annotation_3d.json cannot be read",
    ),
    "lines of another scene": (
        lambda s: change(s / "annotation_3d.json", planeLineMatrix=[[1]]),
        r"its planes, lines and junctions do not belong together",
    ),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_files_are_named_in_one_sentence(scene, damage):
    change_it, message = DAMAGE[damage]
    change_it(scene)
    with pytest.raises(InputError, match=message):
        read(scene)


def test_a_floor_that_does_not_close_is_replaced_by_a_rectangle(scene):
    path = scene / "annotation_3d.json"
    matrix = json.loads(path.read_text())["planeLineMatrix"]
    matrix[0][0] = 0
    change(path, planeLineMatrix=matrix)
    floor_m = read(scene).truth.floor_m
    np.testing.assert_allclose(np.ptp(floor_m, axis=0), (1.7, 2.2), atol=1e-5)  # bed and chair

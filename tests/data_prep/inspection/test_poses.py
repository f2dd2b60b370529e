"""Wrong camera poses under right checksums: `inspect --verify` fails and names what is wrong."""

import h5py
import numpy as np
import pytest
import typer
from front_jobs import change_room, front_job, three_houses
from scan_files import ScanFolder, make_scan, write_table
from typer.testing import CliRunner

from data_prep.cli import add_commands
from data_prep.engine.build import Job, build_shards
from data_prep.inspection.verify import verify
from data_prep.scannet.scans import ScanSettings
from data_prep.scannet.source import ScanNetSource

OPENGL = np.diag([1.0, -1, -1, 1])
MISTAKES = {
    "inverted": (
        np.linalg.inv,
        "world_to_camera seems to hold camera-to-world matrices; inverted, the mean would be 0.9",
    ),
    "opengl": (
        lambda poses: OPENGL @ poses,
        "the cameras seem to have OpenGL axes (y up, z backward) instead of OpenCV's; with y and z "
        "flipped, the mean would be 0.9",
    ),
    "nerfstudio": (
        lambda poses: np.linalg.inv(poses) @ OPENGL,
        "world_to_camera seems to hold camera-to-world matrices with OpenGL axes; inverted, and "
        "with y and z flipped, the mean would be 0.9",
    ),
    "another": (lambda poses: poses[:, [2, 0, 1, 3]], "is an axis or a unit wrong?"),
}


@pytest.fixture
def front_rooms(front, tmp_path):
    """Bedrooms whose furniture has meshes."""
    three_houses(front)
    rules = ("views.per_m2=1.5", "views.image_size=[120, 160]")
    build_shards(front_job(front, tmp_path / "shards", rules=rules))
    return tmp_path / "shards"


@pytest.fixture
def scans(tmp_path):
    """Two scans, known by 3D boxes alone."""
    first = make_scan(tmp_path / "scans" / "scene0000_00")
    second = ScanFolder(tmp_path / "scans" / "scene0001_00", first.boxes, first.alignment)
    second.poses = first.poses
    for scan in (first, second):
        scan.write(mask_size=(242, 324))
    table = write_table(tmp_path / "labels.tsv")
    source = ScanNetSource(tmp_path / "scans", table, ScanSettings(frame_step=1))
    build_shards(Job(source, tmp_path / "shards"))
    return tmp_path / "shards"


def mistake_poses(folder, change, rooms=None):
    """The poses of the first `rooms` rooms, or of all, as another tool might have written them."""
    for path in sorted(folder.glob("*/*.h5")):
        with h5py.File(path) as file:
            count = len(file["rooms"])
        for number in range(count)[:rooms]:
            change_room(path, lambda group: _change(group["world_to_camera"], change), number)
        if rooms is not None:
            return


def _change(poses, change):
    poses[...] = change(poses[()].astype(np.float64))


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("folder", ["front_rooms", "scans"])
def test_wrong_poses_of_all_rooms_fail_and_the_likely_cause_is_named(folder, mistake, request):
    folder = request.getfixturevalue(folder)
    right = verify(folder)
    assert right.problems == ()
    change, cause = MISTAKES[mistake]
    mistake_poses(folder, change)
    wrong = verify(folder)
    # Nothing is left out of the mean for want of a projection.
    assert len(wrong.agreement.mesh) == len(right.agreement.mesh)
    assert len(wrong.agreement.box) == len(right.agreement.box)
    *_, last = wrong.problems
    assert last.startswith(f"{folder}: the projected ") and cause in last
    assert all(cause in problem for problem in wrong.problems)


def test_one_room_with_wrong_poses_is_named_among_right_ones(front_rooms):
    mistake_poses(front_rooms, np.linalg.inv, rooms=1)
    first, *_ = verify(front_rooms).problems
    assert "its ground truth projects onto its masks with a mean 2D IoU of 0.00 only" in first
    assert MISTAKES["inverted"][1] in first


def test_the_command_ends_with_the_cause(front_rooms):
    mistake_poses(front_rooms, MISTAKES["opengl"][0])
    app = typer.Typer()
    add_commands(app)
    ended = CliRunner().invoke(app, ["inspect", str(front_rooms), "--verify"])
    assert ended.exit_code == 3 and "all is well" not in ended.stdout
    assert MISTAKES["opengl"][1] in ended.stderr.strip().splitlines()[-1]

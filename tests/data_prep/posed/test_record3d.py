"""The metadata of Record3D give the cameras of transforms.json."""

import json

import capture_files as tools
import numpy as np
import pytest
from capture_files import refusal, same_masks
from posed_files import prepared


@pytest.mark.parametrize("name", ["metadata", "metadata.json", "EXR_RGBD/metadata"])
def test_record3d(room, plain, name):
    tools.write_record3d(room, name)
    made = prepared(room, up="y")
    # A rotation is a quaternion there, which rounds.
    np.testing.assert_allclose(made.views.world_to_camera, plain.views.world_to_camera, atol=1e-6)
    np.testing.assert_array_equal(made.views.intrinsics, plain.views.intrinsics)
    same_masks(made.views, plain.views)
    (room.folder / "transforms.json").write_text('{"floor_m": 0.0}')
    # Nothing says which axis is up; the cameras do not roll.
    upright = np.linalg.inv(prepared(room).views.world_to_camera.astype(float))
    np.testing.assert_allclose(upright[:, 1, 3], [pose[2, 3] for pose in room.poses], atol=1e-5)


def test_each_frame_of_record3d_has_its_principal_point(room):
    tools.write_record3d(room, per_frame=True)
    made = prepared(room, up="y").views
    np.testing.assert_array_equal(made.intrinsics[:, 0, 2], 64.0 + np.arange(10))


def test_a_pose_that_record3d_lost_is_skipped(room):
    tools.write_record3d(room)
    data = json.loads((room.folder / "metadata").read_text())
    data["poses"][2] = [0.0] * 7
    data["poses"][3][4] = float("nan")
    (room.folder / "metadata").write_text(json.dumps(data))
    assert prepared(room, up="y").notes[0] == "2 of 10 frames have no usable pose; skipped"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda data: data.update(poses=[]), "metadata has no poses; expected one for each"),
        (lambda data: data["poses"][1].pop(), "metadata: poses.1 is "),
        (lambda data: data["K"].pop(), "metadata: K is "),
        (lambda data: data.pop("w"), "metadata: w is "),
        (
            lambda data: data.update(poses=[[0, 0, 0, 1, 0, 0, 0]] * 10),
            "all its poses are the identity, as those of the selfie camera",
        ),
        (
            lambda data: data.update(perFrameIntrinsicCoeffs=[[1, 1, 1, 1]]),
            "perFrameIntrinsicCoeffs has 1 rows, but poses has 10; expected one for each picture",
        ),
    ],
)
def test_recordings_that_cannot_be_used(room, change, said):
    tools.write_record3d(room)
    path = room.folder / "metadata"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    assert said in refusal(room)
    path.write_text(path.read_text()[:-9])
    assert "metadata is not JSON" in refusal(room) and "may be truncated" in refusal(room)

"""Polycam's keyframes give the cameras of transforms.json."""

import json

import capture_files as tools
import numpy as np
import pytest
from capture_files import refusal, same_masks
from posed_files import prepared

from data_prep.readers.posed.transforms import read_recording


@pytest.mark.parametrize("folder", ["corrected_cameras", "cameras"])
def test_polycam(room, plain, folder):
    tools.write_polycam(room, folder)
    made = prepared(room)
    np.testing.assert_array_equal(made.views.world_to_camera, plain.views.world_to_camera)
    np.testing.assert_array_equal(made.views.intrinsics, plain.views.intrinsics)
    same_masks(made.views, plain.views)
    recording = read_recording(room.folder)
    assert recording.metres_per_unit == 1.0 and recording.up == "y"
    pictures = folder.replace("cameras", "images")
    assert recording.frames[0].name == f"keyframes/{pictures}/{tools.timestamp(0)}.jpg"


def test_optimized_keyframes_are_preferred(room):
    tools.write_plain(room)
    tools.write_polycam(room, "corrected_cameras")
    tools.write_plain(room)
    room.focal_px = 70.0
    tools.write_polycam(room, "cameras")
    assert {frame.camera.fl_x for frame in read_recording(room.folder).frames} == {80.0}


def test_keyframes_that_cannot_be_read(room):
    tools.write_polycam(room)
    path = room.folder / "keyframes/corrected_cameras" / f"{tools.timestamp(3)}.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps({**data, "t_12": "far"}))
    assert f"{path}: t_12 is 'far'; input should be a valid number." in refusal(room)
    path.write_text(json.dumps(data)[:40])
    assert f"{path.name} is not JSON" in refusal(room)

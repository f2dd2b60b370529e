"""Recordings written to ScanNet's layout, whole, damaged and truncated."""

import tracemalloc
import zlib

import numpy as np
import pytest
from scan_files import SCANNET_K, frame_header, png, sens_bytes, sens_header

from data_prep.readers.scannet.sens import read_recording
from sceneprior.core.errors import InputError

SIZE = (24, 32)


def poses(count):
    made = np.repeat(np.eye(4)[None], count, axis=0)
    made[:, :3] = np.random.default_rng(0).normal(size=(count, 3, 4)).astype(np.float32)
    return made


def pictures(count):
    return np.random.default_rng(1).integers(0, 256, (count, *SIZE, 3)).astype(np.uint8)


@pytest.fixture
def write(tmp_path):
    def at(data):
        path = tmp_path / "scene0000_00.sens"
        path.write_bytes(data)
        return path

    return at


@pytest.mark.parametrize(("kind", "encode"), [(0, np.ndarray.tobytes), (1, png)])
def test_a_recording_comes_back_pose_by_pose(write, kind, encode):
    images = pictures(4)
    depth = zlib.compress(np.arange(640 * 480, dtype=np.uint16).tobytes())
    data = sens_bytes(poses(4), [encode(image) for image in images], SIZE, kind, depth=depth, imu=3)
    sens = read_recording(write(data))
    assert sens.color_size == SIZE and sens.camera_to_world.dtype == np.float32
    np.testing.assert_array_equal(sens.camera_to_world, poses(4).astype(np.float32))
    # Whole quarters in float32; ScanNet's pixel centres are whole numbers, ours are at i + 0.5.
    centred = SCANNET_K[:3, :3] + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    np.testing.assert_array_equal(sens.intrinsics, centred)


def test_a_recording_cut_anywhere_is_refused_by_name(write):
    data = sens_bytes(poses(3), [b"colour"] * 3, SIZE)
    whole = len(data) - 8  # the count of IMU records, of which we use none
    for cut in range(len(data)):
        path = write(data[:cut])
        if cut == whole:
            read_recording(path)
            continue
        with pytest.raises(InputError, match=r"scene0000_00\.sens, .*, byte \d+: .*truncated"):
            read_recording(path)


def test_the_message_says_where(write):
    data = sens_bytes(poses(3), [b"colour"] * 3, SIZE)
    # 107 bytes a frame: pose and sizes 96, colour 6, depth 5.
    start = len(sens_header(3))
    where = f"frame 1, byte {start + 107 + 96}: the colour picture should take 6 bytes, but 2"
    with pytest.raises(InputError, match=where):
        read_recording(write(data[: start + 107 + 98]))
    with pytest.raises(InputError, match=f"IMU records, byte {start + 321}: their count .*but 3"):
        read_recording(write(data[:-5]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 3}, "header, byte 0: version 3, expected 4"),
        ({"kind": 7}, "compressions 7 .colour. and 1 .depth., expected 0, 1 or 2"),
        ({"size": (0, 32)}, "colour pictures of 32 x 0 .* are implausible"),
        ({"K": np.full((4, 4), np.nan)}, "focal lengths are nan and nan"),
    ],
)
def test_impossible_headers(write, change, words):
    with pytest.raises(InputError, match=words):
        read_recording(write(sens_bytes(poses(1), [b""], **{"size": SIZE, **change})))


def test_impossible_counts_and_sizes_ask_for_no_memory(write):
    tracemalloc.start()
    with pytest.raises(InputError, match=r"header, byte \d+: the recording has no frames"):
        read_recording(write(sens_header(0)))
    with pytest.raises(InputError, match=r"frame 0, byte \d+: its pose and sizes .* but 0 are"):
        read_recording(write(sens_header(1 << 60)))
    negative = (1 << 64) - 1  # -1, read as unsigned
    with pytest.raises(InputError, match=f"frame 0, byte .*depth picture should take {negative}"):
        read_recording(write(sens_header(1) + frame_header(np.eye(4), 0, 0, negative)))
    name = b"\x04\0\0\0" + b"\xff" * 8 + bytes(100)
    with pytest.raises(InputError, match=f"header, byte 12: the sensor's name .* {negative} bytes"):
        read_recording(write(name))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


def test_a_missing_recording(tmp_path):
    with pytest.raises(InputError, match=r"a\.sens cannot be opened .No such file.*<scene>\.sens"):
        read_recording(tmp_path / "a.sens")

"""Selection of the frames that become views, with poses and intrinsics."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_prep.readers.frames import (
    choose_frames,
    mask_intrinsics,
    room_cameras,
    sampled_lines,
)
from data_prep.readers.scannet import FULL_SIZE, QUARTER_SIZE
from sceneprior.core.cameras import camera_centers


def still(count):
    return np.repeat(np.eye(4, dtype=np.float32)[None], count, axis=0)


def test_at_most_a_hundred_of_every_fifteenth_frame():
    assert choose_frames("a", still(100), range(100), 100, step=15) == ([*range(0, 100, 15)], ())
    frames, _ = choose_frames("a", still(15 * 250), range(15 * 250), 100, step=15)
    assert len(frames) == 100 and frames[0] == 0 and frames[-1] == 15 * 249
    assert set(np.diff(frames) // 15) == {2, 3}  # 249 steps of 15 in 99
    assert choose_frames("a", still(99), range(99), at_most=1)[0] == [0]


def test_lost_poses_and_missing_masks_are_counted_and_make_room():
    poses = still(60)
    poses[[0, 20]] = -np.inf
    poses[10, 1, 3] = np.nan
    poses[11] = np.inf  # no candidate
    frames, notes = choose_frames("a", poses, {5, 15, 25, 30, 35, 40, 45, 50}, 8, step=5)
    assert frames == [5, 15, 25, 30, 35, 40, 45, 50]
    assert notes == (
        "3 of 12 frames (every 5) have no usable pose; skipped",
        "1 of 12 frames (every 5) have no image of ids; skipped",  # 55
    )


def test_room_cameras_are_rigid_inverses_of_poses(rng):
    poses = still(5).astype(np.float64)
    poses[:, :3, :3] = Rotation.random(5, rng=2).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(5, 3))
    # Double rounding alone: these rotations are exact.
    np.testing.assert_allclose(
        room_cameras(poses) @ poses, np.broadcast_to(np.eye(4), (5, 4, 4)), atol=1e-14
    )
    # A pose that is off by a rounding is made rigid, its camera left where it stands.
    tilted = poses.copy()
    tilted[:, :3, :3] += rng.normal(scale=1e-3, size=(5, 3, 3))
    cameras = room_cameras(tilted)
    turn = cameras[:, :3, :3]
    np.testing.assert_allclose(turn @ turn.transpose(0, 2, 1), still(5)[:, :3, :3], atol=1e-14)
    np.testing.assert_allclose(camera_centers(cameras), tilted[:, :3, 3], atol=1e-13)


K = np.array([[1170.0, 0.5, 640.75], [0, 1165, 491.25], [0, 0, 1]])


@pytest.mark.parametrize("image_size", [QUARTER_SIZE, FULL_SIZE, (484, 648), (88, 432)])
def test_a_sampled_pixel_is_where_the_lens_says(image_size):
    """By whole steps: the ray through a kept pixel's centre meets the small pixel's centre."""
    lens = mask_intrinsics(K, FULL_SIZE, FULL_SIZE, image_size)
    rows, columns = (sampled_lines(*pair) for pair in zip(FULL_SIZE, image_size, strict=True))
    assert len(np.unique(rows)) == image_size[0] and rows[-1] < 968 and columns[-1] < 1296
    for i, j in ((0, 0), (7, 50), (image_size[0] - 1, image_size[1] - 1)):
        ray = np.linalg.inv(K) @ (columns[j] + 0.5, rows[i] + 0.5, 1)
        # Only rounding: numbers of the size of a pixel coordinate.
        np.testing.assert_allclose(lens @ ray, (j + 0.5, i + 0.5, 1), atol=1e-10)

"""Corrections of poses and masks: known errors are found, and what is right stays."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from untracked_room import furnished

from data_prep.readers.corrected import _adjusted, _gaps, correct, moved_cameras
from data_prep.readers.frames import room_cameras
from data_prep.readers.tangents import find_outlines
from sceneprior.core.observations import observe

DEGREES, METRES = 0.5, 0.01


@pytest.fixture
def given(tmp_path):
    """Masks, world-to-camera matrices and intrinsics of a furnished room, of 320 x 240 pixels."""
    room = furnished(tmp_path)
    room.size, room.focal_px = (240, 320), 160.0
    images = np.stack([room.ids(view) for view in range(len(room.poses))]).astype(np.uint32)
    poses = room_cameras(np.stack(room.poses) @ np.diag([1.0, -1, -1, 1]), np.eye(4))
    lens = np.array([[160.0, 0, 160], [0, 160.0, 120], [0, 0, 1]])
    return images, poses, np.broadcast_to(lens, (len(images), 3, 3))


def seen_in(images):
    return observe(images, [1] * 7)


def errors(count, seed=0):
    """Random turns and moves."""
    ways = np.random.default_rng(seed).normal(size=(count, 2, 3))
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)
    return np.hstack([np.radians(DEGREES) * ways[:, 0], METRES * ways[:, 1]])


def apart_deg(poses, true):
    """Angles by which cameras are turned against each other, more than the true ones."""
    turns = poses[:, :3, :3].transpose(0, 2, 1) @ true[:, :3, :3]
    turns = Rotation.from_matrix(turns)
    return np.degrees((turns.mean().inv() * turns).magnitude())


def test_exact_poses_and_masks_stay(given):
    images, poses, intrinsics = given
    seen = seen_in(images)
    found = correct(seen, poses, intrinsics)
    assert found.world_to_camera is None and found.seen is seen and found.notes == []


@pytest.mark.parametrize("seed", [0, 1])
def test_errors_of_poses_are_found(given, seed):
    """Half a degree and a centimetre; the cameras' centres and the masks tell most of both."""
    images, true, intrinsics = given
    wrong = moved_cameras(true, errors(len(true), seed))
    found = correct(seen_in(images), wrong, intrinsics)
    assert found.world_to_camera is not None
    before, after = apart_deg(wrong, true), apart_deg(found.world_to_camera, true)
    assert np.median(before) > 0.4 and np.median(after) < 0.4 * np.median(before)
    np.testing.assert_allclose(
        np.linalg.inv(found.world_to_camera)[:, 3], np.tile([0, 0, 0, 1.0], (len(true), 1))
    )
    (note,) = found.notes
    assert note.startswith("poses are corrected by 0.") and "outlines now agree to 0." in note


def test_cameras_turn_about_their_centres(given):
    _, poses, _ = given
    change = errors(len(poses))
    for pose, moved, (*turn, x, y, z) in zip(
        poses, moved_cameras(poses, change), change, strict=True
    ):
        before, after = np.linalg.inv(pose), np.linalg.inv(moved)
        np.testing.assert_allclose(after[:3, 3], before[:3, 3] + (x, y, z), atol=1e-12)
        wanted = Rotation.from_rotvec(turn).as_matrix() @ before[:3, :3]
        np.testing.assert_allclose(after[:3, :3], wanted, atol=1e-12)


def test_a_step_solves_the_normal_equations_of_all_gaps(given, monkeypatch):
    """One step, written as weighted least squares over dense rows."""
    images, true, intrinsics = given
    outlines = find_outlines(seen_in(images), intrinsics)
    poses = moved_cameras(true, errors(len(true)))
    monkeypatch.setattr("data_prep.readers.corrected._ROUNDS", 1)
    gaps = _gaps(outlines, poses, np.zeros((len(poses), 6)))
    used = gaps.valid[:, None] & gaps.clear.all(axis=2)
    scale = max(1.0, np.median(np.abs(gaps.gaps_px[used])))
    rows, values = [], []
    for pair, end in np.argwhere(used):
        gap = gaps.gaps_px[pair, end]
        row = np.zeros(6 * len(poses))
        for camera, mask in enumerate(outlines.pairs[pair]):
            place = 6 * outlines.view[mask]
            row[place : place + 6] += gaps.slopes[pair, end, 6 * camera : 6 * camera + 6]
        weight = scale**2 / (scale**2 + gap**2)
        rows.append(weight * row)
        values.append(-weight * gap)
    held = 1 / np.tile([np.radians(1)] * 3 + [0.02] * 3, len(poses))
    rows, values = np.vstack([rows, np.diag(held)]), np.append(values, np.zeros(len(held)))
    wanted = np.linalg.lstsq(rows, values, rcond=None)[0].reshape(-1, 6)
    np.testing.assert_allclose(_adjusted(outlines, poses), wanted, atol=6e-7)


def test_few_objects_or_nonsense_change_nothing(given):
    images, true, intrinsics = given
    wrong = moved_cameras(true, errors(len(true)))
    one = np.where(images == 4, images, 0)
    assert correct(seen_in(one), wrong, intrinsics).world_to_camera is None
    assert correct(seen_in(images[:2]), wrong[:2], intrinsics[:2]).world_to_camera is None
    assert correct(seen_in(images[:1]), wrong[:1], intrinsics[:1]).world_to_camera is None
    seen = seen_in(images)
    found = correct(seen, true[::-1], intrinsics)
    assert found.world_to_camera is None and found.seen is seen and not found.notes


def test_a_mask_of_two_objects_is_void_in_its_view(given):
    """The chair's mask also has the cabinet's pixels; in other views it ends where it should."""
    images, poses, intrinsics = given
    view = next(k for k, image in enumerate(images) if (image == 4).any() and (image == 2).any())
    merged = images.copy()
    merged[view][images[view] == 4] = 2
    before, found = seen_in(merged), correct(seen_in(merged), poses, intrinsics)
    assert found.world_to_camera is None
    assert found.notes == ["1 masks show more than other views of their object: void"]
    assert before.visible[view, 1] and not found.seen.visible[view, 1]
    assert (before.visible != found.seen.visible).sum() == 1
    void = len(found.seen.object_class) + 1
    assert (found.seen.instance_ids[view][merged[view] == 2] == void).all()
    others = np.arange(len(images)) != view
    np.testing.assert_array_equal(
        found.seen.instance_ids[others], before.instance_ids[others].astype(np.uint8)
    )

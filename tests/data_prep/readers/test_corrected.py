"""Corrections of poses and masks, and the gaps between masks of two views that tell of them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from untracked_room import furnished

from data_prep.readers.corrected import (
    _adjusted,
    _changed,
    correct,
    find_outlines,
    measure_gaps,
)
from data_prep.readers.frames import room_cameras
from sceneprior.core.cameras import camera_at, camera_centers
from sceneprior.core.observations import observe

DEGREES, METRES = 0.5, 0.01


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """Masks, world-to-camera matrices and intrinsics of a furnished room, of 320 x 240 pixels."""
    room = furnished(tmp_path_factory.mktemp("room"))
    room.size, room.focal_px = (240, 320), 160.0
    images = np.stack([room.ids(view) for view in range(len(room.poses))]).astype(np.uint32)
    poses = room_cameras(np.stack(room.poses) @ np.diag([1.0, -1, -1, 1]))
    lens = np.array([[160.0, 0, 160], [0, 160.0, 120], [0, 0, 1]])
    return images, poses, np.broadcast_to(lens, (len(images), 3, 3))


def seen_in(images):
    return observe(images, [1] * 7)


def outlines_of(given):
    return find_outlines(seen_in(given[0]), given[2])


def moved_cameras(poses, change):
    return camera_at(*_changed(poses, change))


def by_definition(seen, poses, intrinsics, first, second, item):
    """Both ends of the planes' ranges, in radians about the axis, from the corners of all pixels:
    the angle of a plane is that between its half and the half plane through a fixed point."""
    rotations, centers = poses[:, :3, :3], camera_centers(poses)
    axis = centers[second] - centers[first]
    axis = axis / np.linalg.norm(axis)
    zero = None
    ends = []
    for view in (first, second):
        pixels = np.argwhere(seen.instance_ids[view] == item + 1)[:, ::-1]
        corners = np.concatenate([pixels + each for each in ((0, 0), (1, 0), (0, 1), (1, 1))])
        rays = np.hstack([corners, np.ones((len(corners), 1))]) @ np.linalg.inv(intrinsics[view]).T
        rays = rays @ rotations[view]
        halves = rays - (rays @ axis)[:, None] * axis
        zero = halves[0] / np.linalg.norm(halves[0]) if zero is None else zero
        angles = np.arctan2(np.cross(zero, halves) @ axis, halves @ zero)
        ends.append((angles.min(), angles.max()))
    return np.array(ends)


def test_gaps_match_the_definition(given):
    """Both ends of every tenth pair, with the pixels of all corners in place of a hull's."""
    images, poses, intrinsics = given
    seen, outlines = seen_in(images), outlines_of(given)
    gaps = measure_gaps(outlines, poses, np.zeros((len(poses), 6)))
    assert len(outlines.pairs) > 200 and gaps.valid.mean() > 0.7
    assert np.array_equal(np.unique(outlines.item), np.arange(7))
    for pair in np.flatnonzero(gaps.valid)[::10]:
        first, second = outlines.pairs[pair]
        ends = by_definition(
            seen, poses, intrinsics, outlines.view[first], outlines.view[second],
            outlines.item[first],
        )  # fmt: skip
        inside = (ends[0] - ends[1]) * [1, -1]
        px_per_rad = gaps.gaps_px[pair] / inside
        assert (np.sign(gaps.gaps_px[pair]) == np.sign(inside)).all()
        assert ((px_per_rad > 0) & (px_per_rad < intrinsics[0, 0, 0])).all()
        widths = np.ptp(ends, axis=1)
        np.testing.assert_allclose(gaps.widths_px[pair] / widths, px_per_rad.mean(), rtol=1e-6)


def test_exact_masks_and_poses_have_gaps_below_a_pixel_where_outlines_are_clear(given):
    gaps = measure_gaps(outlines_of(given), given[1], np.zeros((len(given[1]), 6)))
    sizes = gaps.used_px
    assert len(sizes) > 100 and gaps.median_px < 0.3 and (sizes < 1).mean() > 0.9
    assert np.abs(gaps.gaps_px[gaps.valid[:, None] & ~gaps.clear.all(axis=2)]).max() > 5


def test_slopes_are_derivatives(given):
    """Central differences, where the corner that touches the plane stays the same."""
    outlines, poses, step = outlines_of(given), given[1], 1e-6
    nothing = np.zeros((len(poses), 6))
    gaps = measure_gaps(outlines, poses, nothing)
    views = outlines.view[outlines.pairs]
    for camera, place in np.ndindex(2, 6):
        moved = []
        for sign in (-step, step):
            found = np.zeros_like(gaps.gaps_px)
            for view in range(len(poses)):  # one camera at a time
                change = nothing.copy()
                change[view, place] = sign
                mine = views[:, camera] == view
                part = outlines._replace(pairs=outlines.pairs[mine])
                found[mine] = measure_gaps(part, poses, change).gaps_px
            moved.append(found)
        slopes = (moved[1] - moved[0]) / (2 * step)
        off = np.abs(slopes - gaps.slopes[..., 6 * camera + place])[gaps.valid]
        # `gaps_px` also scales with the other camera's place, which the slopes leave out: the
        # larger the gap, the more.
        allowed = 1e-3 + 3 * np.abs(gaps.gaps_px[gaps.valid])
        assert (off < allowed).mean() > 0.98


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


def test_a_step_solves_the_normal_equations_of_all_gaps(given, monkeypatch):
    """One step, written as weighted least squares over dense rows."""
    outlines, true = outlines_of(given), given[1]
    poses = moved_cameras(true, errors(len(true)))
    monkeypatch.setattr("data_prep.readers.corrected._ROUNDS", 1)
    gaps = measure_gaps(outlines, poses, np.zeros((len(poses), 6)))
    scale = max(1.0, np.median(np.abs(gaps.gaps_px[gaps.used])))
    rows, values = [], []
    for pair, end in np.argwhere(gaps.used):
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

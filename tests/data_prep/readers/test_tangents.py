"""Gaps between the masks of two views: against their definition, and derivatives."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from untracked_room import frames, furnished

from data_prep.readers.tangents import find_outlines, hull_corners, measure_gaps
from sceneprior.core.observations import observe


@pytest.fixture
def given(tmp_path):
    """Masks of a furnished room, its poses and intrinsics."""
    room = furnished(tmp_path)
    _, _, poses, intrinsics = frames(room)
    images = np.stack([room.ids(view) for view in range(len(room.poses))]).astype(np.uint32)
    return observe(images, [1] * len(room.things)), poses, intrinsics


def cameras(poses):
    return poses[:, :3, :3], -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])


def test_corners_are_those_of_the_pixels_hull():
    image = np.zeros((20, 30), dtype=np.uint8)
    image[5:9, 4:10] = 2
    image[7, 9] = 0
    image[9, 6] = 2
    corners = hull_corners(image, 2, (slice(5, 10), slice(4, 10)))
    wanted = {(4, 5), (10, 5), (10, 9), (7, 10), (6, 10), (4, 9)}
    assert {tuple(corner) for corner in corners.tolist()} == wanted


def by_definition(seen, poses, intrinsics, first, second, item):
    """Both ends of the planes' ranges, in radians about the axis, from the corners of all pixels:
    the angle of a plane is that between its half and the half plane through a fixed point."""
    rotations, centers = cameras(poses)
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
    seen, poses, intrinsics = given
    outlines = find_outlines(seen, intrinsics)
    gaps = measure_gaps(outlines, *cameras(poses))
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
    seen, poses, intrinsics = given
    gaps = measure_gaps(find_outlines(seen, intrinsics), *cameras(poses))
    used = gaps.valid[:, None] & gaps.clear.all(axis=2)
    sizes = np.abs(gaps.gaps_px[used])
    assert used.sum() > 100 and np.median(sizes) < 0.3 and (sizes < 1).mean() > 0.9
    assert np.abs(gaps.gaps_px[gaps.valid[:, None] & ~gaps.clear.all(axis=2)]).max() > 5


def test_slopes_are_derivatives(given):
    """Central differences, where the corner that touches the plane stays the same."""
    seen, poses, intrinsics = given
    outlines = find_outlines(seen, intrinsics)
    rotations, centers = cameras(poses)
    gaps, step = measure_gaps(outlines, rotations, centers), 1e-6
    views = outlines.view[outlines.pairs]
    for camera in (0, 1):
        for place in range(6):
            moved = []
            for sign in (-step, step):
                change = np.zeros(6)
                change[place] = sign
                found = np.zeros_like(gaps.gaps_px)
                for view in range(len(poses)):  # one camera at a time
                    one, at = rotations.copy(), centers.copy()
                    one[view] = one[view] @ Rotation.from_rotvec(change[:3]).as_matrix().T
                    at[view] += change[3:]
                    mine = views[:, camera] == view
                    part = outlines._replace(pairs=outlines.pairs[mine])
                    found[mine] = measure_gaps(part, one, at).gaps_px
                moved.append(found)
            slopes = (moved[1] - moved[0]) / (2 * step)
            off = np.abs(slopes - gaps.slopes[..., 6 * camera + place])[gaps.valid]
            # `gaps_px` also scales with the other camera's place, which the slopes leave out: the
            # larger the gap, the more.
            allowed = 1e-3 + 3 * np.abs(gaps.gaps_px[gaps.valid])
            assert (off < allowed).mean() > 0.98

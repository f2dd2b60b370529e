"""Single masks join if they show one ball."""

import numpy as np

from data_prep.tracks.carving import cameras_of
from data_prep.tracks.merging import (
    LARGER,
    LEAST,
    MISFIT,
    OFF,
    Discs,
    balls_of,
    discs_of,
    merge_singletons,
    misfits,
)


def seen(middles_m, radius_m, eyes_m) -> Discs:
    """Discs of balls, each seen from each eye."""
    eyes = np.repeat(eyes_m, len(middles_m), axis=0)
    way = np.tile(middles_m, (len(eyes_m), 1)) - eyes
    far = np.linalg.norm(way, axis=1)
    return Discs(eyes, way / far[:, None], radius_m / far)


EYES = np.array([[3.0, 0, 1], [0, 3, 1.2], [-3, 0.5, 1.4], [0.5, -3, 1.1]])
TWO = np.array([[0.8, 0.3, 0.5], [-0.7, -0.4, 0.9]])


def test_singles_of_each_ball_join():
    discs, view = seen(TWO, 0.2, EYES), np.repeat(np.arange(4), 2)
    same = np.ones(8, dtype=np.int64)
    np.testing.assert_array_equal(merge_singletons(np.arange(8), discs, view, same), [0, 1] * 4)


def test_two_views_other_classes_and_larger_clusters_do_not_join():
    discs, view = seen(TWO[:1], 0.2, EYES), np.arange(4)
    apart = np.arange(4)
    np.testing.assert_array_equal(
        merge_singletons(apart, discs, view, np.array([1, 1, 2, 2])), apart
    )
    some = np.array([0, 1, 2, 2])
    np.testing.assert_array_equal(merge_singletons(some, discs, view, np.ones(4, int)), some)
    small = discs._replace(radii=discs.radii * [1, 1, 5, 5])
    np.testing.assert_array_equal(merge_singletons(apart, small, view, np.ones(4, int)), apart)
    gone = discs._replace(radii=discs.radii * [1, 1, 0, 0])
    np.testing.assert_array_equal(merge_singletons(apart, gone, view, np.ones(4, int)), apart)


def test_misfits_by_hand():
    """One pair and one disc at a time, with the ball found by small steps of least squares."""
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(6, 3)) - 1.5 * (eyes := rng.normal(size=(6, 3)))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    discs = Discs(eyes, rays, rng.uniform(0.05, 0.3, 6))
    pairs = np.argwhere(np.arange(6)[:, None] < np.arange(6))
    balls = balls_of(discs, pairs)
    found = misfits(balls, discs)
    for row, (a, b) in enumerate(pairs.tolist()):
        # Depths along both rays at which they are nearest to each other.
        sides = np.stack([rays[a], -rays[b]], axis=1)
        depths = np.linalg.lstsq(sides, eyes[b] - eyes[a], rcond=None)[0]
        middle = (eyes[a] + depths[0] * rays[a] + eyes[b] + depths[1] * rays[b]) / 2
        np.testing.assert_allclose(balls.middles_m[row], middle, atol=1e-6)
        far = [max(np.linalg.norm(middle - eyes[k]), 0.1) for k in range(6)]
        radius = (discs.radii[a] * far[a] + discs.radii[b] * far[b]) / 2
        for k in range(6):
            cosine = (middle - eyes[k]) @ rays[k] / far[k]
            if cosine <= 0:
                assert found[row, k] == np.inf
                continue
            off = np.arccos(min(cosine, 1)) / max(radius / far[k], discs.radii[k]) / OFF
            larger = np.log(radius / far[k] / discs.radii[k]) / np.log(LARGER)
            np.testing.assert_allclose(found[row, k], off**2 + larger**2, rtol=1e-4, atol=2e-6)
    assert np.isinf(found).any() and (found < MISFIT).any() and LEAST == 3


def test_discs_have_the_masks_middles_and_areas():
    ids = np.zeros((2, 40, 60), dtype=np.int32)
    ids[0, 10:20, 30:40], ids[1, 5:9, 2:12] = 1, 3
    lens = np.array([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = 1, 2, 3
    discs = discs_of(ids, np.array([0, 0, 1]), cameras_of(poses, np.stack([lens] * 2), 1))
    ways = np.array([[5 / 50, -5 / 50, 1], [-23 / 50, -13 / 50, 1]])
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    np.testing.assert_allclose(discs.rays[[0, 2]], ways)
    np.testing.assert_allclose(discs.eyes_m[[0, 2]], [[0, 0, 0], [-1, -2, -3]])
    np.testing.assert_allclose(discs.radii, [10 / 50 / np.pi**0.5, 0, (40 / np.pi) ** 0.5 / 50])

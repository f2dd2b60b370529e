"""Shapes that agree with their mirror images."""

import numpy as np

from sceneprior.lifted.lifting.shapes import made_symmetric

FULL = np.ones((8, 8, 8), dtype=bool)


def test_what_one_side_shows_to_be_air_is_air_on_the_other():
    bed = FULL.copy()
    bed[:2, 4:] = False  # seen from one side only
    found = made_symmetric(bed[None])[0]
    assert not found[:2, 4:].any() and not found[-2:, 4:].any()
    assert found[:, :4].all() and found[2:-2].all()


def test_the_outline_from_above_stays():
    shifted = FULL.copy()
    shifted[0] = False  # the box is a cell too wide
    assert np.array_equal(made_symmetric(shifted[None])[0], shifted)


def test_what_is_far_from_symmetric_stays_as_it_is():
    sofa = FULL.copy()
    sofa[4:, :, 4:] = False  # an L
    assert np.array_equal(made_symmetric(sofa[None])[0], sofa)


def test_a_shape_may_be_symmetric_along_one_side_alone_and_never_top_to_bottom():
    chair = FULL.copy()
    chair[:, 3:, 2:] = False  # a seat with a back
    chair[0, 0, 0] = False
    found = made_symmetric(chair[None])[0]
    assert not found[0, 0, 0] and not found[-1, 0, 0]
    expected = chair.copy()
    expected[-1, 0, 0] = False
    assert np.array_equal(found, expected)


def test_each_shape_is_judged_alone_and_nothing_stays_nothing():
    rng = np.random.default_rng(0)
    grids = np.concatenate([rng.random((3, 8, 8, 8)) < 0.9, np.zeros((1, 8, 8, 8), dtype=bool)])
    found = made_symmetric(grids)
    for one, other in zip(grids, found, strict=True):
        assert np.array_equal(made_symmetric(one[None])[0], other)
        assert not (other & ~one).any()
    assert (found.sum(axis=(1, 2, 3))[:3] < grids.sum(axis=(1, 2, 3))[:3]).all()
    assert not found[3].any()

"""Looks along a path: where they are shown, and blends without jumps, whose meshes stay closed."""

import numpy as np
import pytest
import trimesh
from parts_of_rooms import CORNER, TABLE

from sceneprior.core.parts import CYLINDER, DOME, Parts, filled_cells, surface_of_parts
from sceneprior.lifted.shape_morphing import appearances_of, blend_parts, matched_parts

ROUND = Parts(
    np.array([CYLINDER, CYLINDER, DOME]), np.zeros(3, np.int64),
    np.array([
        [[-0.5, 0.5], [0.375, 0.5], [-0.5, 0.5]],
        [[-0.125, 0.125], [-0.375, 0.375], [-0.125, 0.125]],
        [[-0.375, 0.375], [-0.5, -0.375], [-0.375, 0.375]],
    ]),
)  # fmt: skip
SOFA = CORNER._replace(
    outline=np.array([[-0.5, -0.5], [0.2, -0.5], [0.5, -0.1], [0.5, 0.5], [-0.3, 0.5], [-0.5, 0.3]])
)
SHAPES = {"table": TABLE, "corner": CORNER, "round": ROUND, "sofa": SOFA}
PAIRS = [("table", "corner"), ("corner", "sofa"), ("round", "table"), ("round", "sofa")]


def volume(parts: Parts) -> float:
    mesh = trimesh.Trimesh(*surface_of_parts(parts))
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert np.abs(parts.ends).max() == np.abs(parts.ends.min(axis=0)[:, 0]).min() == 0.5
    assert parts.ends.max(axis=0)[:, 1].min() == 0.5, "they fill their box on all sides"
    return float(mesh.volume)


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_shares_of_0_and_1_are_the_ends(first, second):
    a, b = SHAPES[first], SHAPES[second]
    matched = matched_parts(a, b)
    for share, end, same in ((0.0, a, matched[0]), (1.0, b, matched[1])):
        assert blend_parts(*matched, share) is same
        # Hidden solids and added corners change nothing.
        np.testing.assert_array_equal(filled_cells(same, 30, 1.1), filled_cells(end, 30, 1.1))
        assert volume(same) == pytest.approx(volume(end), abs=2e-3)  # every solid grows by 5e-4


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_volumes_change_without_jumps_and_meshes_stay_closed(first, second):
    matched = matched_parts(SHAPES[first], SHAPES[second])
    volumes = [volume(blend_parts(*matched, share)) for share in np.linspace(0, 1, 41).tolist()]
    # All shapes lie in a box of volume 1, and no side moves by more than 1 / 40 of it.
    assert np.abs(np.diff(volumes)).max() < 0.1 and min(volumes) > 0.01
    near = [volume(blend_parts(*matched, share)) for share in (0.0, 1e-5, 1 - 1e-5, 1.0)]
    assert np.abs(np.diff(near)[[0, 2]]).max() < 2e-3  # sides move in steps of a thousandth


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_the_way_back_is_the_way_there(first, second):
    there = matched_parts(SHAPES[first], SHAPES[second])
    back = matched_parts(SHAPES[second], SHAPES[first])
    for one, other in zip(there, back[::-1], strict=True):
        for here, same in zip(one, other, strict=True):
            np.testing.assert_array_equal(here, same)


STEPS = 129


def test_looks_are_shown_at_the_ends_and_in_the_middle_of_where_they_hold():
    looks = np.repeat([5, 7, 9, 7], [33, 32, 8, 56])
    (shown,) = appearances_of(looks, np.ones(STEPS, bool))
    assert shown.looks.tolist() == [5, 7, 7]  # 9 holds for a sixteenth of the path
    np.testing.assert_allclose(shown.places, [0, 48.5 / 128, 1])
    assert shown.at(0.0) == (5, 5, 0.0) or shown.at(0.0) == (5, 7, 0.0)
    assert shown.at(48.5 / 256) == (5, 7, 0.5)
    assert shown.at(0.7) == (7, 7, 0.0) and shown.at(1.0) == (7, 7, 0.0)


def test_an_object_that_comes_and_goes_has_its_own_looks_each_time():
    kept = np.zeros(STEPS, bool)
    kept[[*range(10, 51), *range(90, 129)]] = True
    looks = np.where(np.arange(STEPS) < 30, 1, 2)
    first, second = appearances_of(looks, kept)
    assert first.looks.tolist() == [1, 2] and second.looks.tolist() == [2, 2]
    np.testing.assert_allclose(first.places, [10 / 128, 50 / 128])
    assert first.apart(0.0) == 10 / 128 and first.apart(0.2) == 0
    assert appearances_of(looks, np.zeros(STEPS, bool)) == []
    (once,) = appearances_of(looks, np.arange(STEPS) == 10)
    assert once.at(10 / 128) == (1, 1, 0.0)

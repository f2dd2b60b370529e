"""Every kind of wrong array is one sentence; right ones are none."""

from dataclasses import replace

import numpy as np
import pytest
from front_jobs import bedroom_shards, rooms_of

from data_prep.inspection.checks import array_problems, mask_problems, truth_problems


@pytest.fixture(scope="module")
def made(made_once):
    """(views, truth) of a bedroom with a bed and two nightstands."""
    (pair,) = rooms_of(made_once("bedroom", bedroom_shards)).values()
    return pair


def changed(room, name, change):
    value = getattr(room, name).copy()
    change(value)
    return replace(room, **{name: value})


def test_prepared_rooms_are_right(made):
    assert [*array_problems(made[0], 22), *mask_problems(made[0]), *truth_problems(*made)] == []


def put(place, value):
    def change(array):
        array[place] = value

    return change


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("object_class", put(1, 0), "a class index is outside 1 to 21"),
        ("world_to_camera", put((1, 3, 3), 2.0), "the camera of view 1 is no rotation"),
        (
            "intrinsics",
            put((1, 0, 0), -60.0),
            "the intrinsics of view 1 are not those of a pinhole",
        ),
        ("boxes", put((0, 0), (0.2, 0.2, 1.1, 0.9)), "a 2D box reaches beyond the image"),
        ("visible", put(slice(None), False), "an object that is not visible in a view has a box"),
    ],
)
def test_values_out_of_range(made, name, change, said):
    assert any(
        sentence.startswith(said) or said in sentence
        for sentence in array_problems(changed(made[0], name, change), 22)
    )


def test_an_object_that_no_view_shows(made):
    room = made[0]
    for name in ("visible", "boxes", "mask_pixels"):
        room = changed(room, name, put((slice(None), 1), 0))
    assert list(array_problems(room, 22)) == ["no view shows object 1"]


def test_boxes_and_masks_that_do_not_fit(made):
    room = made[0]
    view, k = (int(i) for i in np.argwhere(room.visible)[0])
    for name, change, said in (
        ("boxes", put((view, k, 0), 0.5), f"view {view}, object {k}: its 2D box does not fit its"),
        ("mask_pixels", put((view, k), 7), f"view {view}, object {k}: its mask has "),
        ("visible", put((view, k), False), f"view {view}, object {k} is said to be not visible, "),
    ):
        (sentence,) = mask_problems(changed(room, name, change))
        assert sentence.startswith(said)
    (sentence,) = mask_problems(changed(room, "instance_ids", put(room.instance_ids == k + 1, 0)))
    assert sentence.endswith("is said to be visible, but its mask is 0 x 0 pixels")


def test_a_side_that_is_not_clear(made):
    room = made[0]
    hidden = np.argwhere(room.visible[..., None] & ~room.sides_clear)
    for view, k, side in hidden:
        claimed = changed(room, "sides_clear", put((view, k, side), True))
        found = list(mask_problems(claimed))
        if found:  # not so where void furniture touches, which is 0 in the image
            assert found[0].endswith("touches a side of its box that is said to be clear")
            return
    pytest.fail("no side of this room is touched by a tracked object")


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("sizes_m", lambda a: -a, "ground truth: a size is negative"),
        ("object_class", lambda a: a + 1, "ground truth: its first rows are not the tracked obj"),
    ],
)
def test_a_ground_truth_that_cannot_be(made, name, change, said):
    views, truth = made
    wrong = replace(truth, **{name: change(getattr(truth, name))})
    assert any(said in sentence for sentence in truth_problems(views, wrong))


def test_a_ground_truth_that_lacks_rows(made):
    views, truth = made
    assert list(truth_problems(views, replace(truth, object_class=truth.object_class[:2])))


def test_occlusion_of_another_number_of_views(made):
    views, truth = made
    flags = np.ones((1, *views.visible.shape[1:]), dtype=bool)
    (said,) = truth_problems(views, replace(truth, unoccluded=flags))
    assert said == (
        f"ground truth: unoccluded has shape {flags.shape}, expected {views.visible.shape}"
    )

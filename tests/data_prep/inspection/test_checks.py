"""Every kind of wrong array is one sentence; right ones are none."""

from dataclasses import replace

import numpy as np
import pytest
from front_jobs import bedroom_shards, rooms_of
from golden_values import hold

from data_prep.inspection.verify import array_problems, mask_problems, truth_problems


@pytest.fixture(scope="module")
def made(made_once):
    """(views, truth) of a bedroom with a bed and two nightstands."""
    (pair,) = rooms_of(made_once("bedroom", bedroom_shards)).values()
    return pair


def put(**changes):
    """A change of a room's arrays: each gets a value at a place."""

    def change(room):
        arrays = {name: getattr(room, name).copy() for name in changes}
        for name, (place, value) in changes.items():
            arrays[name][place] = value
        return replace(room, **arrays)

    return change


def first_object(value, **place):
    """A change where the first visible object is."""

    def change(room):
        view, k = np.argwhere(room.visible)[0]
        ((name, more),) = place.items()
        return put(**{name: ((view, k, *more), value)})(room)

    return change


def first_mask_gone(room):
    k = np.argwhere(room.visible)[0, 1]
    return put(instance_ids=(room.instance_ids == k + 1, 0))(room)


WRONG = {
    "class": put(object_class=(1, 0)),
    "camera": put(world_to_camera=((1, 3, 3), 2.0)),
    "lens": put(intrinsics=((1, 0, 0), -60.0)),
    "box beyond the image": put(boxes=((0, 0), (0.2, 0.2, 1.1, 0.9))),
    "nothing visible": put(visible=(slice(None), False)),
    "an object no view shows": put(
        **dict.fromkeys(("visible", "boxes", "mask_pixels"), ((slice(None), 1), 0))
    ),
    "box and mask": first_object(0.5, boxes=(0,)),
    "pixels and mask": first_object(7, mask_pixels=()),
    "not visible, with a mask": first_object(False, visible=()),
    "visible, without a mask": first_mask_gone,
}  # fmt: skip


def problems(room):
    return [*array_problems(room, 22), *mask_problems(room)]


def test_prepared_rooms_are_right(made):
    assert [*problems(made[0]), *truth_problems(*made)] == []


@pytest.mark.parametrize("name", WRONG)
def test_wrong_arrays(made, name):
    hold("checks", {name: problems(WRONG[name](made[0]))}, slack=0.02)


def test_a_side_that_is_not_clear(made):
    room = made[0]
    hidden = np.argwhere(room.visible[..., None] & ~room.sides_clear)
    # Where void furniture touches, which is 0 in the image, nothing is found.
    claimed = (put(sides_clear=(tuple(side), True))(room) for side in hidden)
    found = [said for wrong in claimed for said in mask_problems(wrong)]
    assert found and all(said.endswith("of its box that is said to be clear") for said in found)


def test_a_ground_truth_that_cannot_be(made):
    views, truth = made
    for name, wrong in {
        "size": replace(truth, sizes_m=-truth.sizes_m),
        "other classes": replace(truth, object_class=truth.object_class + 1),
        "too few rows": replace(truth, object_class=truth.object_class[:2]),
        "occlusion": replace(truth, unoccluded=np.ones((1, *views.visible.shape[1:]), dtype=bool)),
    }.items():
        hold("checks", {f"truth, {name}": list(truth_problems(views, wrong))})

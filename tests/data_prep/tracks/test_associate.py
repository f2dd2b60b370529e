"""Objects found from masks of single frames are the boxes that were drawn."""

import numpy as np
import pytest
from posed_files import PosedRoom
from untracked_room import frames, furnished

from data_prep.tracks.associate import FrameMasks, associate


@pytest.fixture
def room(tmp_path) -> PosedRoom:
    return furnished(tmp_path)


def test_each_box_is_one_object(room):
    masks, true, poses, lenses = frames(room)
    found = associate(masks, poses, lenses)
    pairs = set(zip(true[np.maximum(masks.ids, 0)].ravel(), found.ids.ravel(), strict=True))
    assert len(pairs) == 1 + len(room.things)  # background and a one-to-one map
    names = sorted({thing.name for thing in room.things})
    for k, number in pairs - {(0, 0)}:
        assert found.object_class[number - 1] == names.index(room.things[k - 1].name) + 1


def test_ids_and_world_do_not_matter(room):
    """Another order of the ids, and a world that is turned and moved, find the same objects."""
    masks, true, poses, lenses = frames(room)
    first = associate(masks, poses, lenses).ids
    shuffled, true_too, *_ = frames(room, seed=1)
    assert (true[masks.ids] == true_too[shuffled.ids]).all() and (masks.ids != shuffled.ids).any()
    world = np.eye(4)
    world[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    world[:3, 3] = 3.2, -0.64, 0.96  # whole cells of the coarse grid
    second = associate(shuffled, poses @ np.linalg.inv(world), lenses).ids
    pairs = set(zip(first.ravel(), second.ravel(), strict=True))
    assert len(pairs) == 1 + len(room.things)


def test_a_wrong_class_is_outvoted(room):
    masks, _, poses, lenses = frames(room)
    right = associate(masks, poses, lenses)
    classes = masks.mask_class.copy()
    classes[::20] = classes[::20] % 4 + 1
    found = associate(masks._replace(mask_class=classes), poses, lenses)
    np.testing.assert_array_equal(found.ids, right.ids)
    np.testing.assert_array_equal(found.object_class, right.object_class)


def test_no_masks_are_no_objects(room):
    masks, _, poses, lenses = frames(room)
    none = FrameMasks(np.full_like(masks.ids, -1), np.zeros(0, dtype=np.int64))
    found = associate(none, poses, lenses)
    assert (found.ids == -1).all() and not len(found.object_class)


def test_an_object_that_most_masks_miss_is_one_object(room):
    """Most views show background where the lamp is, so that no cell of it is filled."""
    masks, true, poses, lenses = frames(room)
    lamp = np.flatnonzero(true == 7)
    ids = np.where(np.isin(masks.ids, lamp[4:]), 0, masks.ids)
    found = associate(masks._replace(ids=ids), poses, lenses).ids
    assert len(np.unique(found[np.isin(ids, lamp)])) == 1
    assert len(np.unique(found)) == 1 + len(room.things)

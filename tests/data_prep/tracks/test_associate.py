"""Objects found from masks of single frames are the boxes that were drawn."""

import numpy as np
import pytest
from posed_files import PosedRoom, Thing

from data_prep.frames import room_cameras
from data_prep.tracks.associate import FrameMasks, associate


def furnished(folder) -> PosedRoom:
    """Seven boxes, two of them side by side and alike, seen from twelve places."""
    things = [
        Thing(1, "bed", (-0.9, -0.8, 0.0), (0.5, 1.0, 0.5)),
        Thing(2, "chair", (0.9, 0.4, 0.0), (1.3, 0.8, 0.9)),
        Thing(3, "chair", (0.9, -0.3, 0.0), (1.3, 0.1, 0.9)),
        Thing(4, "cabinet", (-1.9, -0.5, 0.0), (-1.4, 0.3, 1.8)),
        Thing(5, "nightstand", (-0.9, 1.1, 0.0), (-0.5, 1.5, 0.5)),
        Thing(6, "nightstand", (0.1, 1.1, 0.0), (0.5, 1.5, 0.5)),
        Thing(7, "lamp", (-0.2, -0.1, 2.2), (0.2, 0.3, 2.5)),
    ]
    room = PosedRoom(folder, things, size=(120, 160), focal_px=80.0, poses=[])
    room.poses.clear()
    for k in range(12):
        angle = 2 * np.pi * k / 12
        target = (0.3 * np.cos(3 * angle), 0.3, 0.6 + 0.5 * (k % 3))
        room.look((2.6 * np.cos(angle), 2.6 * np.sin(angle), 1.5), target)
    return room


def frames(room: PosedRoom, seed: int = 0):
    """Masks with an id of their own, the true object of each, poses and intrinsics."""
    rng = np.random.default_rng(seed)
    names = sorted({thing.name for thing in room.things})
    ids, true, classes = [], [0], []
    for view in range(len(room.poses)):
        image = room.ids(view)
        own = np.zeros(image.shape, dtype=np.int32)
        for k in rng.permutation(np.unique(image[image > 0])).tolist():
            own[image == k] = len(true)
            true.append(k)
            classes.append(names.index(room.things[k - 1].name) + 1)
        ids.append(own)
    height, width = room.size
    lens = np.array([[room.focal_px, 0, width / 2], [0, room.focal_px, height / 2], [0, 0, 1]])
    poses = room_cameras(np.stack(room.poses) @ np.diag([1.0, -1, -1, 1]), np.eye(4))
    masks = FrameMasks(np.stack(ids), np.array(classes))
    return masks, np.array(true), poses, np.broadcast_to(lens, (len(ids), 3, 3))


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

"""Single images out of shards."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sceneprior.core.errors import InputError
from sceneprior.core.observed_image import (
    as_views,
    image_from_shards,
    image_of_room,
    images_of_split,
)
from sceneprior.core.shards import RoomViews, Shard, iterate_rooms, list_shards


@pytest.fixture(scope="module")
def room(toy_shards) -> RoomViews:
    with Shard(list_shards(toy_shards, "test")[0]) as shard:
        return shard.read_room(shard.room_ids[0], images=True)


def test_only_what_the_view_shows_remains(room):
    view = int(np.flatnonzero(~room.visible.all(axis=1) & room.visible.any(axis=1))[0])
    image = image_of_room(room, view, "front3d_bedroom")
    rows = np.flatnonzero(room.visible[view])
    assert image.rows == tuple(rows)
    for k, row in enumerate(rows):
        mask = image.instance_ids == k + 1
        np.testing.assert_array_equal(mask, room.instance_ids[view] == row + 1)
        assert image.object_class[k] == room.object_class[row]
        np.testing.assert_array_equal(image.boxes[k], room.boxes[view, row])
    assert image.instance_ids.max() == len(rows)


def test_a_view_that_is_not_there_or_shows_nothing(room):
    with pytest.raises(InputError, match=r"has no view 8; its 8 views are 0 to 7\."):
        image_of_room(room, 8, "front3d_bedroom")
    blank = replace(room, visible=np.zeros_like(room.visible))
    with pytest.raises(InputError, match="View 2 of room toy/test_00 shows no object"):
        image_of_room(blank, 2, "front3d_bedroom")


def test_rooms_are_found_in_either_split(toy_shards):
    assert image_from_shards(toy_shards, "toy/test_01", 3).room_id == "toy/test_01"
    assert image_from_shards(toy_shards, "toy/train_07", 3).name == "toy_train_07_view3"
    with pytest.raises(InputError, match="holds no room 'attic'; it has 16 rooms, such as toy/te"):
        image_from_shards(toy_shards, "attic", 0)


def test_views_are_drawn_by_the_seed_room_by_room(toy_shards):
    images, blank = images_of_split(toy_shards, "test", 1)
    again, _ = images_of_split(toy_shards, "test", 1, limit=2)
    other, _ = images_of_split(toy_shards, "test", 2)
    views = [image.view for image in images]
    assert blank == [] and len(images) == 4
    assert [image.view for image in again] == views[:2]
    assert [image.view for image in other] != views


def test_more_views_of_a_room_are_further_ones(toy_shards):
    one, _ = images_of_split(toy_shards, "test", 1)
    three, _ = images_of_split(toy_shards, "test", 1, views=3)
    every, _ = images_of_split(toy_shards, "test", 1, views=100)
    assert [image.name for image in three[::3]] == [image.name for image in one]
    assert len(three) == 12 and len({image.name for image in three}) == 12
    useful = {
        (room, view)
        for shard, room in iterate_rooms(toy_shards, "test")
        for view in np.flatnonzero(shard.read_room(room).visible.any(axis=1))
    }
    assert {(image.room_id, image.view) for image in every} == useful
    assert len(every) == len(useful)


def test_a_batch_is_one_view_a_room(toy_shards):
    images, _ = images_of_split(toy_shards, "test", 0)
    views = as_views(images, 4)
    counts = [len(image.object_class) for image in images]
    assert views.is_object.sum(dim=1).tolist() == counts
    assert views.visible.shape == (4, 1, max(counts))
    assert views.instance_ids.shape == (4, 1, 18, 24)
    for row, image in enumerate(images):
        sampled = torch.from_numpy(image.instance_ids[2::4, 2::4].astype(np.int32))
        assert torch.equal(views.instance_ids[row, 0], sampled)


def test_void_stays_the_id_after_the_last_objects_of_an_image(room):
    view = int(np.flatnonzero(~room.visible.all(axis=1) & room.visible.any(axis=1))[0])
    void = room.instance_ids[view] == 0
    ids = np.where(room.instance_ids == 0, len(room.object_class) + 1, room.instance_ids)
    image = image_of_room(replace(room, instance_ids=ids), view, "front3d_bedroom")
    np.testing.assert_array_equal(image.instance_ids == len(image.object_class) + 1, void)


def test_images_of_two_sizes_are_no_batch(toy_shards):
    images, _ = images_of_split(toy_shards, "test", 0, limit=2)
    small = replace(images[1], instance_ids=images[1].instance_ids[::2])
    with pytest.raises(InputError, match=r"\(36, 96\) and \(72, 96\) pixels"):
        as_views([images[0], small], 4)

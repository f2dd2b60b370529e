"""Rooms as boxes, split into batches or with other slots; cameras in pixels of other images."""

import pytest
import torch
from torch.testing import assert_close

from sceneprior.core.dataset import ViewDataset
from sceneprior.core.views import RoomBoxes


@pytest.fixture
def rooms(torch_rng) -> RoomBoxes:
    """Five rooms of 1 to 4 objects."""
    is_object = torch.arange(4) < torch.tensor([[1], [4], [2], [3], [1]])
    label = torch.randint(1, 9, (5, 4), generator=torch_rng) * is_object
    return RoomBoxes(label, is_object, torch.rand(5, 4, 6, generator=torch_rng), tuple("abcde"))


def test_batches_are_the_rooms_one_after_the_other(rooms):
    batches = rooms.split(2)
    assert [len(batch.is_object) for batch in batches] == [2, 2, 1]
    for name in ("object_class", "is_object", "boxes_m"):
        joined = torch.cat([getattr(batch, name) for batch in batches])
        assert torch.equal(joined, getattr(rooms, name))
    assert not any(batch.room_ids for batch in batches)


def test_slots_are_those_that_are_asked_for(rooms, torch_rng):
    order = torch.stack([torch.randperm(4, generator=torch_rng)[:3] for _ in range(5)])
    taken = rooms.take(order)
    for room in range(5):
        for place, slot in enumerate(order[room].tolist()):
            assert taken.object_class[room, place] == rooms.object_class[room, slot]
            assert taken.is_object[room, place] == rooms.is_object[room, slot]
            assert torch.equal(taken.boxes_m[room, place], rooms.boxes_m[room, slot])
    assert taken.room_ids == rooms.room_ids


def test_intrinsics_of_another_size_show_the_same_picture(toy_shards):
    views = ViewDataset(toy_shards, "train", views_per_room=2).__getitems__([(0, 0), (1, 0)])
    height, width = views.image_size
    point_m = torch.tensor([0.3, 0.4, 1.7])
    here = views.intrinsics @ point_m
    there = views.intrinsics_at(height / 3, width / 4) @ point_m
    assert_close(there / here, torch.tensor([1 / 4, 1 / 3, 1]).expand(2, 2, 3))

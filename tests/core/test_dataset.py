"""Batches of views: what a data set gives, in which order, and which images it reads."""

import pickle

import numpy as np
import pytest
import torch
from references.batches import batch_room_by_room, rooms_with_images
from toy_rooms import make_toy_room, write_shard

from sceneprior.core.dataset import BLANK, MaskStore, ViewDataset
from sceneprior.core.errors import ShardError
from sceneprior.core.observations import RoomViews
from sceneprior.core.shards import Shard, list_shards
from sceneprior.training.steps import DrawSampler, make_loader


def dataset(shards, **changes) -> ViewDataset:
    return ViewDataset(shards, "train", **{"views_per_room": 5, **changes})


@pytest.fixture(scope="module")
def rooms(toy_shards) -> list[RoomViews]:
    return rooms_with_images(toy_shards, "train")


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"rotations": 4, "seed": 3},
        {"views_per_room": 11, "mask_step": 4},
        {"view_fraction": 0.4, "mask_step": 3, "rotations": 4},
    ],
    ids=str,
)
def test_batches_are_those_made_room_by_room(toy_shards, rooms, changes):
    settings = {"views_per_room": 5, **changes}
    data = dataset(toy_shards, **settings)
    if not changes:
        assert data.room_ids == tuple(f"toy/train_{k:02d}" for k in range(12))
    rng = np.random.default_rng(0)
    for size in (1, 3, 8, 8):
        draws = [
            (int(row), int(epoch)) for row, epoch in rng.integers(0, (len(data), 9), (size, 2))
        ]
        views = data.__getitems__(draws)
        by_hand = batch_room_by_room(rooms, draws, **settings)
        for name, expected in by_hand.items():
            found = getattr(views, name)
            assert torch.equal(found, torch.from_numpy(expected)), name
            assert found.dtype == torch.from_numpy(expected).dtype, name
        assert views.instance_ids is None or "instance_ids" in by_hand


@pytest.mark.parametrize(
    ("rows", "batch", "world"), [(12, 4, 1), (12, 5, 1), (13, 4, 2), (13, 3, 2), (3, 2, 4)]
)
def test_each_epoch_visits_every_room_once_split_over_processes(rows, batch, world):
    samplers = [DrawSampler(rows, batch, 7, rank, world) for rank in range(world)]
    alone = DrawSampler(rows, batch * world, 7)
    orders = []
    for epoch in range(3):
        for sampler in [*samplers, alone]:
            sampler.set_epoch(epoch)
        shared = [list(sampler) for sampler in samplers]
        whole = list(alone)
        # Nobody waits for a process that has no batch left.
        assert {len(batches) for batches in shared} == {len(whole)} == {len(alone)}
        assert {len(sampler) for sampler in samplers} == {len(whole)}
        for parts, together in zip(zip(*shared, strict=True), whole, strict=True):
            drawn = [draw for part in parts for draw in part if draw[1] != BLANK]
            assert sorted(drawn) == sorted(together)
            assert all(1 <= len(part) <= batch for part in parts)
            # Blank draws only fill up for those who got none.
            assert all(len(part) == 1 for part in parts if part[0][1] == BLANK)
        visited = [row for part in whole for row, _ in part]
        assert sorted(visited) == list(range(rows))
        assert {e for part in whole for _, e in part} == {epoch}
        orders.append(visited)
        again = DrawSampler(rows, batch, 7, 0, world)
        again.set_epoch(epoch)
        assert list(again) == shared[0]
    assert orders[0] != orders[1] or rows < 4


def test_a_blank_draw_is_a_room_in_which_there_is_nothing(toy_shards):
    data = dataset(toy_shards, mask_step=4)
    views = data.__getitems__([(3, BLANK)])
    assert views.room_index.tolist() == [3] and views.instance_ids is not None
    assert not views.is_object.any() and not views.visible.any()
    mixed, plain = data.__getitems__([(3, BLANK), (4, 2)]), data.__getitems__([(4, 2)])
    count = int(plain.is_object.sum())
    assert torch.equal(mixed.visible[1, :, :count], plain.visible[0])


def test_the_loader_gives_whole_batches_and_learns_of_epochs(toy_shards):
    data = dataset(toy_shards)
    loader = make_loader(data, 5, 0, 0)
    # As Lightning does it: it never speaks to the batch sampler itself.
    loader.batch_sampler.sampler.set_epoch(2)
    batches = list(loader)
    assert [len(views.room_index) for views in batches] == [5, 5, 2]
    row = int(batches[0].room_index[0])
    assert torch.equal(
        batches[0].world_to_camera[0], data.__getitems__([(row, 2)]).world_to_camera[0]
    )


def test_workers_stand_between_only_where_masks_are_read(toy_shards):
    assert make_loader(dataset(toy_shards), 5, 0, workers=2).num_workers == 0
    assert make_loader(dataset(toy_shards, mask_step=4), 5, 0, workers=2).num_workers == 2


def test_a_data_set_moved_to_a_device_makes_its_batches_there(toy_shards):
    data = dataset(toy_shards, mask_step=4)
    before = data.__getitems__([(3, 0), (1, 0)])
    assert data.to("meta") is data  # a device that holds no numbers: nothing may be read from it
    for name in ("boxes", "world_to_camera", "room_index", "instance_ids"):
        found = getattr(data.__getitems__([(3, 0), (1, 0)]), name)
        assert found.device.type == "meta" and found.shape == getattr(before, name).shape


def test_folders_that_cannot_be_used_say_so(tmp_path):
    write_shard(tmp_path / "train" / "a.h5", "front3d_bedroom", [])
    with pytest.raises(ShardError, match=r"/train hold no rooms; prepare them again"):
        dataset(tmp_path)
    room = make_toy_room("a", np.random.default_rng(0))
    write_shard(tmp_path / "train" / "a.h5", "front3d_bedroom", [room])
    write_shard(tmp_path / "train" / "b.h5", "scannet", [room])
    with pytest.raises(
        ShardError, match="is labelled 'scannet' but its neighbours 'front3d_bedroo"
    ):
        dataset(tmp_path)


def places(folder):
    found = []
    for path in list_shards(folder, "train"):
        with Shard(path) as shard:
            found += [(path, room_id) for room_id in shard.room_ids]
    return found


def test_only_views_asked_for_are_read_and_only_once(toy_shards, monkeypatch):
    asked = []
    read = Shard.read_instance_ids

    def watched(shard, room_id, views, step):
        asked.append((room_id, list(views)))
        return read(shard, room_id, views, step)

    monkeypatch.setattr(Shard, "read_instance_ids", watched)
    rooms = rooms_with_images(toy_shards, "train")
    store = MaskStore(places(toy_shards), 4)
    for views in ([5, 2, 5], [2], [0, 5, 2]):
        small = rooms[7].instance_ids[views, 2::4, 2::4]
        found = store.read(7, np.array(views))
        np.testing.assert_array_equal(found, small)
        assert found.dtype == small.dtype
    assert asked == [(rooms[7].room_id, [2, 5]), (rooms[7].room_id, [0])]
    assert 0 < sum(map(len, store._packed[7].values())) < 3 * 18 * 24 / 2


def test_few_files_stay_open_and_none_travels_to_a_worker(toy_shards, monkeypatch):
    monkeypatch.setattr("sceneprior.core.dataset._OPEN_SHARDS", 1)
    store = MaskStore(places(toy_shards), 4)
    first = store.read(0, np.arange(8))
    first_shard = next(iter(store._shards.values()))
    store.read(11, np.arange(8))
    assert len(store._shards) == 1 and not first_shard._file  # closed
    again = pickle.loads(pickle.dumps(store))
    assert not again._shards
    np.testing.assert_array_equal(again.read(0, np.arange(8)), first)
    np.testing.assert_array_equal(again.read(5, np.arange(8)), store.read(5, np.arange(8)))

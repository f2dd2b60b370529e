"""Masks: only what is drawn is read, once, and it is kept small."""

import pickle

import numpy as np
from references.batches import rooms_with_images

from sceneprior.core import dataset
from sceneprior.core.dataset import MaskStore
from sceneprior.core.shards import Shard, list_shards


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
    monkeypatch.setattr(dataset, "_OPEN_SHARDS", 1)
    store = MaskStore(places(toy_shards), 4)
    first = store.read(0, np.arange(8))
    first_shard = next(iter(store._shards.values()))
    store.read(11, np.arange(8))
    assert len(store._shards) == 1 and not first_shard._file  # closed
    again = pickle.loads(pickle.dumps(store))
    assert not again._shards
    np.testing.assert_array_equal(again.read(0, np.arange(8)), first)
    np.testing.assert_array_equal(again.read(5, np.arange(8)), store.read(5, np.arange(8)))

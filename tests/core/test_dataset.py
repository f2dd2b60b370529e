"""Batches of views: what a data set gives, in which order, and which images it reads."""

import pickle

import numpy as np
import pytest
import torch
from references.batches import batch_room_by_room, rooms_with_images, turn_about_up
from torch.testing import assert_close
from toy_rooms import make_toy_room, write_shard

from sceneprior.core.boxes import box_corners
from sceneprior.core.cameras import boxes_of_points
from sceneprior.core.dataset import BLANK, MaskStore, ViewDataset
from sceneprior.core.errors import ShardError
from sceneprior.core.observations import RoomViews
from sceneprior.core.shards import Shard, list_shards
from sceneprior.core.views import RoomBoxes
from sceneprior.training.steps import DrawSampler, make_loader


def dataset(shards, **changes) -> ViewDataset:
    return ViewDataset(shards, "train", **{"views_per_room": 5, **changes})


@pytest.fixture(scope="module")
def rooms(toy_shards) -> list[RoomViews]:
    return rooms_with_images(toy_shards, "train")


def drawn_views(data: ViewDataset, rooms: list[RoomViews], row: int, epoch: int) -> list[int]:
    """Indices of the room's views that a draw contains, found by their cameras."""
    views = data.__getitems__([(row, epoch)])
    room = rooms[row // data.rotations]
    known = room.world_to_camera @ turn_about_up(row % data.rotations).T
    return [
        int(np.abs(known - pose).sum(axis=(1, 2)).argmin())
        for pose in views.world_to_camera[0].numpy()
    ]


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


def test_ids_above_255_can_be_compared_with_objects(toy_shards, monkeypatch):
    """Torch stores uint16, but does not compare it with other integers."""
    wide = Shard.read_instance_ids
    monkeypatch.setattr(
        Shard, "read_instance_ids", lambda *given: wide(*given).astype(np.uint16) + 255
    )
    views = dataset(toy_shards, mask_step=4).__getitems__([(2, 0)])
    assert views.instance_ids.min() == 255 and (~views.known_pixels).all()


def test_draws_are_a_function_of_seed_row_and_epoch_alone(toy_shards, rooms):
    data = dataset(toy_shards, seed=4)
    first = [drawn_views(data, rooms, row, epoch) for row in range(3) for epoch in range(4)]
    again = dataset(toy_shards, seed=4)
    # In another order, in other batches, in another process: the same.
    backwards = [
        drawn_views(again, rooms, row, epoch) for row in (2, 1, 0) for epoch in (3, 2, 1, 0)
    ]
    assert first == backwards[::-1]
    in_batch = again.__getitems__([(1, 2), (0, 0), (2, 3)])
    alone = again.__getitems__([(0, 0)])
    assert torch.equal(in_batch.world_to_camera[1], alone.world_to_camera[0])
    assert all(len(set(draw)) == 5 for draw in first)  # without replacement
    assert len({tuple(draw) for draw in first}) > 8
    other = dataset(toy_shards, seed=5)
    assert [
        drawn_views(other, rooms, row, epoch) for row in range(3) for epoch in range(4)
    ] != first


def test_few_views_are_shown_about_equally_often(toy_shards, rooms):
    data = dataset(toy_shards, views_per_room=20)
    draw = drawn_views(data, rooms, 0, 0)
    counts = np.bincount(draw, minlength=8)
    assert len(draw) == 20 and counts.min() == 2 and counts.max() == 3


@pytest.mark.parametrize(("fraction", "kept"), [(1.0, 8), (0.5, 4), (0.25, 2), (0.01, 1)])
def test_view_fraction_keeps_the_same_share_of_each_rooms_views(toy_shards, rooms, fraction, kept):
    data = dataset(toy_shards, view_fraction=fraction)
    for row in range(4):
        seen = set().union(*(drawn_views(data, rooms, row, epoch) for epoch in range(30)))
        assert len(seen) == kept
    if fraction == 0.5:
        subsets = {tuple(allowed) for allowed in data._allowed}
        assert len(subsets) > 6


def test_a_turned_room_under_turned_cameras_looks_the_same(toy_shards, rooms):
    """Rows 4k to 4k + 3 are room k turned by 0, 90, 180, 270 degrees about +y."""
    data = dataset(toy_shards, rotations=4)
    assert len(data) == 48
    assert data.room_ids[:4] == tuple("toy/train_00" + turn for turn in ("", "@90", "@180", "@270"))
    with Shard(list_shards(toy_shards, "train")[0]) as shard:
        truth = shard.read_ground_truth(rooms[0].room_id)
    n = len(rooms[0].object_class)
    center = torch.from_numpy(truth.centers_m[:n])
    size = torch.from_numpy(truth.sizes_m[:n])
    for quarter in range(4):
        views = data.__getitems__([(quarter, 0)])
        found = boxes_of_points(
            box_corners(center, size)[None], views.world_to_camera, views.intrinsics, (72, 96)
        )
        plain = [
            boxes_of_points(
                box_corners(
                    torch.from_numpy(truth.centers_m[:n]), torch.from_numpy(truth.sizes_m[:n])
                )[None],
                torch.from_numpy(rooms[0].world_to_camera[[view]])[None],
                views.intrinsics[:, :1],
                (72, 96),
            ).boxes[0, 0]
            for view in drawn_views(data, rooms, quarter, 0)
        ]
        # Quarter turns are exact in floats; what is left is the order of sums.
        assert_close(found.boxes[0], torch.stack(plain), rtol=0, atol=1e-5)
        # +z turns towards +x: (x, z) -> (z, -x).
        center = torch.stack([center[:, 2], center[:, 1], -center[:, 0]], dim=1)
        size = size[:, [2, 1, 0]]


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


@pytest.fixture
def boxes(torch_rng) -> RoomBoxes:
    """Five rooms of 1 to 4 objects."""
    is_object = torch.arange(4) < torch.tensor([[1], [4], [2], [3], [1]])
    label = torch.randint(1, 9, (5, 4), generator=torch_rng) * is_object
    return RoomBoxes(label, is_object, torch.rand(5, 4, 6, generator=torch_rng), tuple("abcde"))


def test_batches_are_the_rooms_one_after_the_other(boxes):
    batches = boxes.split(2)
    assert [len(batch.is_object) for batch in batches] == [2, 2, 1]
    for name in ("object_class", "is_object", "boxes_m"):
        joined = torch.cat([getattr(batch, name) for batch in batches])
        assert torch.equal(joined, getattr(boxes, name))
    assert not any(batch.room_ids for batch in batches)


def test_slots_are_those_that_are_asked_for(boxes, torch_rng):
    order = torch.stack([torch.randperm(4, generator=torch_rng)[:3] for _ in range(5)])
    taken = boxes.take(order)
    for room in range(5):
        for place, slot in enumerate(order[room].tolist()):
            assert taken.object_class[room, place] == boxes.object_class[room, slot]
            assert taken.is_object[room, place] == boxes.is_object[room, slot]
            assert torch.equal(taken.boxes_m[room, place], boxes.boxes_m[room, slot])
    assert taken.room_ids == boxes.room_ids


def test_intrinsics_of_another_size_show_the_same_picture(toy_shards):
    views = ViewDataset(toy_shards, "train", views_per_room=2).__getitems__([(0, 0), (1, 0)])
    height, width = views.image_size
    point_m = torch.tensor([0.3, 0.4, 1.7])
    here = views.intrinsics @ point_m
    there = views.intrinsics_at(height / 3, width / 4) @ point_m
    assert_close(there / here, torch.tensor([1 / 4, 1 / 3, 1]).expand(2, 2, 3))

"""Lifted rooms in batches: rows of the views, boxes and shapes found once."""

import shutil

import h5py
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from sceneprior.data.dataset import BLANK, ViewDataset
from sceneprior.geometry.turns import turn_boxes
from sceneprior.lifting import dataset as module
from sceneprior.lifting.dataset import LiftedDataset
from sceneprior.lifting.shapes import ShapeGrid, lift_shapes
from sceneprior.shards import iterate_rooms

GRID = ShapeGrid(cells=8, margin=1.2, codes=200)


@pytest.fixture(scope="module")
def shards(toy_shards, tmp_path_factory):
    """Of its own, since boxes are kept beside the shards; one shard of six rooms, no truth."""
    folder = tmp_path_factory.mktemp("lifted") / "shards"
    shutil.copytree(toy_shards, folder)
    for path in sorted((folder / "train").iterdir())[1:]:
        path.unlink()
    for path in (folder / "train").iterdir():
        with h5py.File(path, "r+") as file:
            for group in file["rooms"].values():
                del group["ground_truth"]
    return folder


def test_rows_and_objects_are_those_of_the_views_and_truth_is_not_needed(shards):
    lifted = LiftedDataset(shards, "train", rotations=4)
    views = ViewDataset(shards, "train", 3, rotations=4)
    assert lifted.room_ids == views.room_ids and lifted.max_objects == views.max_objects
    draws = [(7, 0), (0, 3), (2, 1)]
    mine, theirs = lifted.__getitems__(draws), views.__getitems__(draws)
    for name in ("room_index", "object_class", "is_object"):
        assert torch.equal(getattr(mine, name), getattr(theirs, name))
    assert mine.room_ids == theirs.room_ids
    assert mine.shape_codes is None


def test_turned_rows_are_turned_rooms(shards, monkeypatch):
    rng = np.random.default_rng(0)
    monkeypatch.setattr(
        module,
        "lift_shapes",
        lambda views, *_: rng.random((len(views.object_class), 8, 8, 8)) < 0.5,
    )
    monkeypatch.setattr(module, "write_whole", lambda *_: None)
    data = LiftedDataset(shards, "train", rotations=4, shape=GRID._replace(margin=1.15))
    data.place_shapes(data.space)
    plain, turned = data.__getitems__([(4, 0)]), data.__getitems__([(7, 2)])
    assert torch.equal(turned.boxes_m, turn_boxes(plain.boxes_m, torch.tensor([3])))
    # All shapes in all turns are in the space: codes give turned grids back.
    assert data.space is not None
    for item in range(int(plain.is_object.sum())):
        before, after = (
            data.space.mean + np.tensordot(batch.shape_codes[0, item].numpy(), data.space.basis, 1)
            for batch in (plain, turned)
        )
        np.testing.assert_allclose(np.rot90(before, 3, axes=(2, 0)), after, rtol=0, atol=1e-3)
        assert np.abs(before - after).max() > 0.9


def test_codes_are_those_of_the_lifted_shapes_in_the_order_of_objects(shards):
    data = LiftedDataset(shards, "train", shape=GRID)
    assert data.__getitems__([(1, 0)]).shape_codes is None, "not before they have a space"
    data.place_shapes(data.space)
    batch = data.__getitems__([(1, 0), (3, 0)])
    for row, (shard, room_id) in enumerate(iterate_rooms(shards, "train")):
        if row in (1, 3):
            grids = lift_shapes(shard.read_room(room_id, images=True), data.boxes[row], GRID)
            wanted = torch.from_numpy(data.space.codes_of(grids))
            found = batch.shape_codes[(row - 1) // 2, : len(grids)]
            assert_close(found, wanted, rtol=0, atol=1e-5)
            filled = batch.shape_cells[(row - 1) // 2, : len(grids)].tolist()
            assert filled == grids.sum(axis=(1, 2, 3)).clip(min=1).tolist()
    assert LiftedDataset(shards, "train").__getitems__([(1, 0)]).shape_codes is None


def test_a_blank_draw_is_a_room_in_which_there_is_nothing(shards):
    batch = LiftedDataset(shards, "train", shape=GRID).__getitems__([(0, BLANK)])
    assert not batch.is_object.any() and not batch.is_lifted.any()


def test_a_space_of_many_shapes_is_found_from_some(shards, monkeypatch):
    monkeypatch.setattr(module, "MOST_SHAPES", 12)
    space, again = (LiftedDataset(shards, "train", rotations=4, shape=GRID).space for _ in "ab")
    # Three objects in four turns have at most eleven components.
    assert 0 < space.basis.any(axis=(1, 2, 3)).sum() <= 11
    np.testing.assert_array_equal(space.basis, again.basis)


def test_shapes_are_found_once_and_again_on_other_grids(shards, monkeypatch):
    LiftedDataset(shards, "train", shape=GRID)
    calls = []
    find = module.lift_shapes
    monkeypatch.setattr(module, "lift_shapes", lambda *given: calls.append(1) or find(*given))
    LiftedDataset(shards, "train", shape=GRID._replace(codes=2))
    assert calls == [], "codes are found from the same shapes"
    LiftedDataset(shards, "train", shape=GRID._replace(margin=1.3))
    assert len(calls) == 6


def test_boxes_are_found_once_and_again_when_views_change(shards, monkeypatch):
    first = LiftedDataset(shards, "train")
    calls = []
    find = module.lift_boxes
    monkeypatch.setattr(module, "lift_boxes", lambda *given: calls.append(1) or find(*given))
    second = LiftedDataset(shards, "train")
    assert calls == []
    for one, other in zip(first.boxes, second.boxes, strict=True):
        np.testing.assert_array_equal(one.centers_m, other.centers_m)
    part = LiftedDataset(shards, "train", view_fraction=0.5)
    assert len(calls) == len(part.plain_ids) == 6
    (shards / "lifted_train.npz").write_bytes(b"not a zip")
    LiftedDataset(shards, "train")
    assert len(calls) == 12, "a damaged file is not believed"


def test_a_read_only_folder_is_enough(shards, monkeypatch):
    (shards / "lifted_train.npz").unlink(missing_ok=True)

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(module, "write_whole", refuse)
    assert len(LiftedDataset(shards, "train").boxes) == 6
    assert not (shards / "lifted_train.npz").exists()

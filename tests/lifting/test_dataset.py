"""Lifted rooms in batches: rows of the views, rays by epoch, boxes found once."""

import shutil

import h5py
import numpy as np
import pytest
import torch

from sceneprior.data.dataset import BLANK, ViewDataset
from sceneprior.geometry.turns import turn_boxes
from sceneprior.lifting import dataset as module
from sceneprior.lifting.dataset import LiftedDataset


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
    assert mine.ray_hits is None


def test_turned_rows_are_turned_rooms(shards):
    data = LiftedDataset(shards, "train", rotations=4, rays_per_object=6)
    plain, turned = data.__getitems__([(4, 0)]), data.__getitems__([(7, 0)])
    assert torch.equal(turned.boxes_m, turn_boxes(plain.boxes_m, torch.tensor([3])))
    # Each copy draws its own rays from the pool of the room, turned: -z to x.
    pool = torch.from_numpy(data._rays[1].directions)
    back = turned.ray_directions[0, : len(pool)][..., [2, 1, 0]] * torch.tensor([1.0, 1, -1])
    for item in range(len(pool)):
        assert (back[item].unsqueeze(1) == pool[item]).all(dim=-1).any(dim=1).all()


def test_rays_depend_on_seed_row_and_epoch_alone(shards):
    data = LiftedDataset(shards, "train", rays_per_object=8, seed=5)
    once, again = data.__getitems__([(1, 2), (3, 2)]), data.__getitems__([(3, 2)])
    count = int(again.is_object.sum())
    assert torch.equal(once.ray_directions[1, :count], again.ray_directions[0, :count])
    later = data.__getitems__([(3, 3)])
    assert not torch.equal(again.ray_directions, later.ray_directions)
    assert later.ray_until_m[~later.is_object].eq(0).all()


def test_a_blank_draw_is_a_room_in_which_there_is_nothing(shards):
    batch = LiftedDataset(shards, "train", rays_per_object=4).__getitems__([(0, BLANK)])
    assert not batch.is_object.any() and not batch.is_lifted.any() and not batch.ray_until_m.any()


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

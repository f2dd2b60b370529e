"""Lifted rooms in batches: rows of the views, boxes and shapes found once."""

import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from refusals import refused
from rooms_of_walls import L_SHAPE, shell_room
from toy_rooms import LABEL_SET, write_shard

from sceneprior.core.boxes import turn_boxes, turn_grids
from sceneprior.core.classes import VOID
from sceneprior.core.dataset import BLANK, ViewDataset, allowed_views
from sceneprior.core.errors import ShardError
from sceneprior.core.wall_lines import find_walls
from sceneprior.lifted.lifting import ShapeGrid, boxes, dataset
from sceneprior.lifted.lifting.dataset import LiftedDataset
from sceneprior.lifted.prototypes import POSES, turn_of

GRID = ShapeGrid(cells=8, margin=1.2)


@pytest.fixture(scope="module")
def shards(toy_shards, tmp_path_factory):
    """A copy of the toy shards, since boxes are stored beside them: one shard of six rooms, without
    3D ground truth."""
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
    lifted = LiftedDataset(shards, "train", GRID, rotations=4)
    views = ViewDataset(shards, "train", 3, rotations=4)
    assert lifted.room_ids == views.room_ids and lifted.max_objects == views.max_objects
    draws = [(7, 0), (0, 3), (2, 1)]
    mine, theirs = lifted.__getitems__(draws), views.__getitems__(draws)
    for name in ("room_index", "object_class", "is_object"):
        assert torch.equal(getattr(mine, name), getattr(theirs, name))
    assert mine.room_ids == theirs.room_ids
    assert (mine.looks == -1).all()
    blank = lifted.__getitems__([(0, BLANK)])
    assert not blank.is_object.any() and not blank.is_lifted.any()


def test_turned_rows_are_turned_rooms(shards):
    data = LiftedDataset(shards, "train", GRID, rotations=4)
    prototypes = data.find_prototypes(99)
    odd = np.random.default_rng(0).random((1, 8, 8, 8))  # another grid in every pose
    data.assign_prototypes(prototypes)
    plain, turned = data.__getitems__([(4, 0)]), data.__getitems__([(7, 2)])
    assert torch.equal(turned.boxes_m, turn_boxes(plain.boxes_m, torch.tensor([3])))
    for item in range(int(plain.is_object.sum())):
        before, after = (int(batch.looks[0, item]) for batch in (plain, turned))
        assert before // POSES == after // POSES
        here, there = (turn_grids(odd, *turn_of(look % POSES))[0] for look in (before, after))
        np.testing.assert_array_equal(np.rot90(here, 3, axes=(2, 0)), there)


def test_what_has_no_label_or_no_box_has_no_look(shards):
    data = LiftedDataset(shards, "train", GRID)
    prototypes = data.find_prototypes(99)
    data.object_classes[0] = VOID
    data.boxes.explained[1] = 0
    assert data.usable.tolist()[:3] == [False, False, True]
    assert data.posed_prototypes(prototypes)[0].tolist()[:2] == [-1, -1]
    data.assign_prototypes(prototypes)
    assert data.__getitems__([(0, 0)]).looks[0, :2].tolist() == [-1, -1]


def test_boxes_are_found_once_and_again_when_views_change(shards, monkeypatch):
    first = LiftedDataset(shards, "train", GRID)
    calls = []
    find = boxes.lift_boxes
    monkeypatch.setattr(boxes, "lift_boxes", lambda *room: calls.append(1) or find(*room))
    second = LiftedDataset(shards, "train", GRID)
    assert calls == []
    for one, other in zip(
        (*first.boxes, *first.rays, first.hulls()), (*second.boxes, *second.rays, second.hulls()),
        strict=True,
    ):  # fmt: skip
        np.testing.assert_array_equal(one, other)
    part = LiftedDataset(shards, "train", GRID, view_fraction=0.5)
    assert len(calls) == len(part.plain_ids) == 6
    (shards / "lifted_train.npz").write_bytes(b"not a zip")
    LiftedDataset(shards, "train", GRID)
    assert len(calls) == 12, "a damaged file is not believed"


def test_rooms_in_which_nothing_can_be_lifted_are_a_sentence(shards):
    with refused("lifted/nothing lifted", ShardError, shards=shards):
        LiftedDataset(shards, "train", GRID, view_fraction=1 / 8)


def test_walls_are_found_once_in_the_views_that_training_uses(tmp_path, monkeypatch):
    room = shell_room(
        L_SHAPE, [(-1.0, 0.5), (-1.2, -0.8), (0.9, -0.7)], block=(0.5, -1.4, 1.5, -0.9)
    )
    bare = replace(room, room_id="bare", stuff=None)
    write_shard(tmp_path / "train" / "a.h5", LABEL_SET, [(bare, None), (room, None)])
    lifted = LiftedDataset(tmp_path, "train", GRID, view_fraction=0.5)
    none, walls = lifted.walls
    assert not none and len(walls) >= 5
    used = allowed_views(0, 1, len(room.visible), 0.5)
    for mine, theirs in zip(walls, find_walls(room, used)[0], strict=True):
        np.testing.assert_array_equal(np.hstack(mine), np.hstack(theirs))
    monkeypatch.setattr(dataset, "find_walls", None)
    again = LiftedDataset(tmp_path, "train", GRID, view_fraction=0.5).walls[1]
    np.testing.assert_array_equal([np.hstack(w) for w in again], [np.hstack(w) for w in walls])

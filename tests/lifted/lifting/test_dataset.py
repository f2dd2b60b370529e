"""Lifted rooms in batches: rows of the views, boxes and shapes found once."""

import shutil
from dataclasses import replace
from itertools import islice

import h5py
import numpy as np
import pytest
import torch
from rooms_of_walls import L_SHAPE, shell_room
from toy_rooms import LABEL_SET, write_shard

from sceneprior.core.boxes import turn_boxes, turn_grids
from sceneprior.core.classes import VOID
from sceneprior.core.dataset import BLANK, ViewDataset, allowed_views
from sceneprior.core.errors import ShardError
from sceneprior.core.parts import whole_box
from sceneprior.core.shards import iterate_rooms
from sceneprior.core.wall_lines import find_walls
from sceneprior.lifted.lifting import RayPool, ShapeGrid, boxes, cache, hulls, prototype_fitting
from sceneprior.lifted.lifting.boxes import draw_rays
from sceneprior.lifted.lifting.dataset import LiftedDataset
from sceneprior.lifted.lifting.prototype_fitting import explain_rays
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
    lifted = LiftedDataset(shards, "train", rotations=4)
    views = ViewDataset(shards, "train", 3, rotations=4)
    assert lifted.room_ids == views.room_ids and lifted.max_objects == views.max_objects
    draws = [(7, 0), (0, 3), (2, 1)]
    mine, theirs = lifted.__getitems__(draws), views.__getitems__(draws)
    for name in ("room_index", "object_class", "is_object"):
        assert torch.equal(getattr(mine, name), getattr(theirs, name))
    assert mine.room_ids == theirs.room_ids
    assert mine.looks is None


def test_turned_rows_are_turned_rooms(shards):
    data = LiftedDataset(shards, "train", rotations=4, shape=GRID)
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


def test_looks_are_those_of_the_rays_in_the_order_of_objects(shards):
    data = LiftedDataset(shards, "train", shape=GRID)
    assert data.__getitems__([(1, 0)]).looks is None, "not before there are prototypes"
    prototypes = data.find_prototypes(99)
    data.assign_prototypes(prototypes)
    batch = data.__getitems__([(1, 0), (3, 0)])
    for row, (shard, room_id) in enumerate(iterate_rooms(shards, "train")):
        if row in (1, 3):
            room = shard.read_room(room_id, images=True)
            rays = draw_rays(room, data.boxes[row], 1024, GRID.margin)
            rays = RayPool(*(part.astype(np.float16) for part in rays[:2]), rays.hits)
            known = (data.boxes[row].explained > 0) & (room.object_class != VOID)
            sizes_m = np.where(known[:, None], data.boxes[row].sizes_m, 1)
            labels = room.object_class.astype(np.int64)
            wanted = explain_rays(prototypes, rays, sizes_m, labels, GRID.margin)
            found = batch.looks[(row - 1) // 2, : len(labels)].numpy()
            np.testing.assert_array_equal(found, np.where(known, wanted, -1))
            assert (found >= 0).any()


def test_what_has_no_label_or_no_box_has_no_look(shards):
    data = LiftedDataset(shards, "train", shape=GRID)
    prototypes = data.find_prototypes(99)
    data.object_classes[0] = VOID
    data.boxes[0].explained[1] = 0
    assert data.usable.tolist()[:3] == [False, False, True]
    assert data.posed_prototypes(prototypes).tolist()[:2] == [-1, -1]
    data.assign_prototypes(prototypes)
    assert data.__getitems__([(0, 0)]).looks[0, :2].tolist() == [-1, -1]


def test_a_blank_draw_is_a_room_in_which_there_is_nothing(shards):
    batch = LiftedDataset(shards, "train", shape=GRID).__getitems__([(0, BLANK)])
    assert not batch.is_object.any() and not batch.is_lifted.any()


def test_shapes_are_found_once_and_again_on_other_grids(shards, monkeypatch):
    LiftedDataset(shards, "train", shape=GRID)
    calls = []
    find = hulls.lift_shapes
    monkeypatch.setattr(hulls, "lift_shapes", lambda *given: calls.append(1) or find(*given))
    LiftedDataset(shards, "train", shape=GRID)
    assert calls == []
    LiftedDataset(shards, "train", shape=GRID._replace(margin=1.3))
    assert len(calls) == 6


def test_parts_are_found_once_and_again_for_other_prototypes(shards, monkeypatch):
    (shards / "lifted_parts_train.npz").unlink(missing_ok=True)
    fitted, fit = [], prototype_fitting.fit_prototypes
    monkeypatch.setattr(
        prototype_fitting, "fit_prototypes", lambda *given: fitted.append(fit(*given)) or fitted[-1]
    )
    first = LiftedDataset(shards, "train", shape=GRID).find_prototypes(99)
    data = LiftedDataset(shards, "train", shape=GRID)
    again = data.find_prototypes(99)
    assert len(fitted) == 1 and len(first.parts) > 1
    for wanted, one, other in zip(fitted[0], first.parts, again.parts, strict=True):
        for name in wanted._fields:
            value = getattr(wanted, name)
            np.testing.assert_array_equal(getattr(one, name), value, strict=True)
            np.testing.assert_array_equal(getattr(other, name), value, strict=True)
    np.testing.assert_array_equal(first.grids, again.grids)
    # Other prototypes.
    data.object_classes[data.object_classes == data.object_classes[0]] = VOID
    assert len(data.find_prototypes(99).parts) < len(first.parts) and len(fitted) == 2


def test_a_folder_that_is_gone_stays_gone(tmp_path):
    gone = cache.LiftedCache(tmp_path / "gone", "train", [], "")
    parts = (whole_box(), whole_box()._replace(outline=whole_box().outline[:3]))
    found = gone.parts(np.array([3, 4]), GRID, lambda: parts)
    assert [len(each.outline) for each in found] == [4, 3] and not gone.folder.exists()


def test_boxes_are_found_once_and_again_when_views_change(shards, monkeypatch):
    first = LiftedDataset(shards, "train")
    calls = []
    find = boxes.lift_boxes
    monkeypatch.setattr(boxes, "lift_boxes", lambda *given: calls.append(1) or find(*given))
    second = LiftedDataset(shards, "train")
    assert calls == []
    for one, other in zip(first.boxes, second.boxes, strict=True):
        np.testing.assert_array_equal(one.centers_m, other.centers_m)
    part = LiftedDataset(shards, "train", view_fraction=0.5)
    assert len(calls) == len(part.plain_ids) == 6
    (shards / "lifted_train.npz").write_bytes(b"not a zip")
    LiftedDataset(shards, "train")
    assert len(calls) == 12, "a damaged file is not believed"


@pytest.mark.parametrize("what", ["object_class", "sides_clear", "instance_ids"])
def test_boxes_are_found_again_when_classes_sides_or_images_change(toy_shards, tmp_path, what):
    """Only these: a data set labelled anew, or with void where there was nothing."""
    keys = []
    for change in (False, True):
        rooms = []
        for shard, room_id in islice(iterate_rooms(toy_shards, "train"), 2):
            room = shard.read_room(room_id, images=True)
            values = getattr(room, what)
            if change and what == "object_class":
                values[:] = values % 20 + 1
            elif change and what == "sides_clear":
                values[0] = False
            elif change:
                values[values == 0] = len(room.object_class) + 1
            rooms.append((room, None))
        (tmp_path / "train" / "a.h5").unlink(missing_ok=True)
        write_shard(tmp_path / "train" / "a.h5", LABEL_SET, rooms)
        LiftedDataset(tmp_path, "train")
        with np.load(tmp_path / "lifted_train.npz") as kept:
            keys.append(str(kept["key"]))
    assert keys[0] != keys[1]


def test_rooms_in_which_nothing_can_be_lifted_are_a_sentence(shards):
    with pytest.raises(
        ShardError,
        match=r"None of the \d+ objects in the 6 'train' rooms of .* at least two views of a room, "
        r"and here are 6 views \(at data.view_fraction 0.125\)\. Prepare more or larger views",
    ):
        LiftedDataset(shards, "train", view_fraction=1 / 8, shape=GRID)


def test_a_read_only_folder_is_enough(shards, monkeypatch):
    (shards / "lifted_train.npz").unlink(missing_ok=True)

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(cache, "write_whole", refuse)
    assert len(LiftedDataset(shards, "train").boxes) == 6
    assert not (shards / "lifted_train.npz").exists()


def test_walls_are_found_once_in_the_views_that_training_uses(tmp_path, monkeypatch):
    room = shell_room(
        L_SHAPE, [(-1.0, 0.5), (-1.2, -0.8), (0.9, -0.7)], block=(0.5, -1.4, 1.5, -0.9)
    )
    bare = replace(room, room_id="bare", stuff=None)
    write_shard(tmp_path / "train" / "a.h5", LABEL_SET, [(bare, None), (room, None)])
    lifted = LiftedDataset(tmp_path, "train", view_fraction=0.5)
    none, walls = lifted.walls()
    assert not none and len(walls) >= 5
    used = allowed_views(0, 1, len(room.visible), 0.5)
    for mine, theirs in zip(walls, find_walls(room, used)[0], strict=True):
        np.testing.assert_array_equal(np.hstack(mine), np.hstack(theirs))
    monkeypatch.setattr(cache, "find_walls", None)
    again = LiftedDataset(tmp_path, "train", view_fraction=0.5).walls()[1]
    np.testing.assert_array_equal([np.hstack(w) for w in again], [np.hstack(w) for w in walls])

"""True boxes as batches: what they say, how rooms turn, and who may read them."""

import ast
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch

import sceneprior
from sceneprior.baselines.one_stage import TruthDataset
from sceneprior.core.dataset import BLANK, ViewDataset
from sceneprior.core.shards import iterate_rooms

PACKAGE = Path(sceneprior.__file__).parent
UNMIRRORED = [(row, row % 2) for row in range(8, 12)]
"""Draws of the four turns of a room, each in an epoch in which it is not mirrored."""


def test_a_batch_says_what_the_shards_say(toy_shards):
    data = TruthDataset(toy_shards, "train")
    truth = {
        room: shard.read_ground_truth(room) for shard, room in iterate_rooms(toy_shards, "train")
    }
    batch = data.__getitems__([(7, 0), (0, 3), (2, 1)])
    assert batch.room_ids == tuple(data.room_ids[row] for row in (7, 0, 2))
    for row, room_id in enumerate(batch.room_ids):
        true = truth[room_id]
        there = batch.is_object[row]
        assert there.tolist() == sorted(there.tolist(), reverse=True)
        assert int(there.sum()) == len(true.object_class)
        np.testing.assert_array_equal(batch.object_class[row, there], true.object_class)
        np.testing.assert_array_equal(batch.boxes_m[row, there, :3], true.centers_m)
        np.testing.assert_array_equal(batch.boxes_m[row, there, 3:], true.sizes_m)
        assert not batch.object_class[row, ~there].any()
    assert data.max_objects == max(len(true.object_class) for true in truth.values())


def test_rows_are_those_of_the_views(toy_shards):
    """So that an epoch of a baseline is as many rooms as one of ours."""
    for rotations in (1, 4):
        views = ViewDataset(toy_shards, "train", 4, rotations=rotations)
        assert TruthDataset(toy_shards, "train", rotations).room_ids == views.room_ids


def test_two_epochs_show_a_room_in_its_eight_symmetries(toy_shards, torch_rng):
    dataset = TruthDataset(toy_shards, "train", 4)
    dataset._yaw_rad = (torch.rand(dataset._yaw_rad.shape, generator=torch_rng) - 0.5) * 2 * np.pi
    turns = dataset.__getitems__(UNMIRRORED)
    mirrored = dataset.__getitems__([(row, 1 - epoch) for row, epoch in UNMIRRORED])
    there = turns.is_object[0]
    for turn in range(4):
        # Mirroring x and then turning is turning back and then mirroring along the axis that x
        # has become; it leaves a front's other component.
        axis = 2 * (turn % 2)
        signs = torch.ones(6)
        signs[axis] = -1
        wanted = turns.boxes_m[turn] * signs
        assert torch.equal(mirrored.boxes_m[turn, there], wanted[there])
        fronts = [torch.stack([b.yaw_rad.sin(), b.yaw_rad.cos()], -1) for b in (turns, mirrored)]
        flipped = fronts[0][turn] * signs[[0, 2]]
        np.testing.assert_allclose(fronts[1][turn, there], flipped[there], atol=1e-6)
    shown = torch.cat([turns.boxes_m, mirrored.boxes_m])[:, there].flatten(1)
    assert len(shown.unique(dim=0)) == 8
    everything = dataset.everything()
    assert len(everything.boxes_m) == 2 * len(dataset)
    middle_m = everything.boxes_m[everything.is_object].double().mean(dim=0)
    assert middle_m[[0, 2]].abs().max() < 1e-6
    plain = TruthDataset(toy_shards, "train")
    first, second = (plain.__getitems__([(1, epoch)]).boxes_m for epoch in (0, 1))
    assert torch.equal(first, second)


def test_a_process_without_a_room_of_its_own_gets_nothing_in_no_room(toy_shards):
    batch = TruthDataset(toy_shards, "train").__getitems__([(3, BLANK)])
    assert batch.room_ids == () and not batch.is_object.any() and not batch.object_class.any()


def test_only_baselines_with_3d_supervision_read_the_ground_truth():
    """By the imports of the whole package: evaluation reads it; retrieval reads the classes of CAD
    models; of what trains, one module reads boxes, and one reads views with true meshes."""
    importers = defaultdict(set)
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE).as_posix()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and node.attr == "read_ground_truth":
                importers[node.attr].add(name)
            if isinstance(node, ast.ImportFrom):
                importers[node.module].add(name)
                for alias in node.names:
                    importers[alias.name].add(name)
    assert importers["read_ground_truth"] == {
        "baselines/one_stage.py", "core/ground_truth.py", "apps/retrieval/cad_models.py"
    }  # fmt: skip
    trains = ("paper/", "lifted/", "training/", "baselines/")
    readers = {n for n in importers["sceneprior.core.ground_truth"] if n.startswith(trains)}
    views = "baselines/single_view"
    assert readers == {f"{views}/detector.py", "lifted/reconstruction/known_rooms.py"}
    assert importers["TruthDataset"] == set()
    assert importers["BoxConfig"] == {
        f"baselines/{name}.py" for name in ("atiss", "sync2gen", "set_flow")
    }
    assert importers["TrueViewDataset"] == set()
    assert importers["DetectorConfig"] == {f"{views}/{name}.py" for name in ("total3d", "im3d")}

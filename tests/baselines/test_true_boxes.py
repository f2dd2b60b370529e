"""True boxes as batches: what they say, how rooms turn, and who may read them."""

import ast
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from tiny_runs import tiny_baseline, tiny_config

from sceneprior.baselines.true_boxes import TruthDataset
from sceneprior.data.dataset import BLANK, ViewDataset
from sceneprior.errors import ShardError
from sceneprior.geometry.corners import box_corners
from sceneprior.geometry.turns import turn_boxes
from sceneprior.shards import Shard, iterate_rooms

PACKAGE = Path(__file__).parents[2] / "sceneprior"


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


def test_a_turned_room_is_the_room_seen_by_turned_cameras(toy_shards):
    """Camera and box turn together: in the camera's frame the same corners, in another order."""
    boxes = TruthDataset(toy_shards, "train", 4).__getitems__([(row, 0) for row in range(8, 12)])
    views = ViewDataset(toy_shards, "train", 1, rotations=4).__getitems__(
        [(row, 0) for row in range(8, 12)]
    )
    # The views of a room's four copies are drawn each by itself: turn the plain copy's by hand.
    plain = views.world_to_camera[0, 0]
    quarter = torch.tensor([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    seen = []
    for turn in range(4):
        camera = plain @ torch.linalg.matrix_power(quarter, turn).T
        corners = box_corners(boxes.boxes_m[turn, :, :3], boxes.boxes_m[turn, :, 3:])
        points = corners @ camera[:3, :3].T + camera[:3, 3]
        seen.append(np.sort(points.numpy().round(4), axis=1))
    for other in seen[1:]:
        np.testing.assert_allclose(other, seen[0], atol=2e-4)


def test_fronts_turn_with_their_pieces(toy_shards, torch_rng):
    dataset = TruthDataset(toy_shards, "train", 4)
    dataset._yaw_rad = (torch.rand(dataset._yaw_rad.shape, generator=torch_rng) - 0.5) * 2 * np.pi
    boxes = dataset.__getitems__([(row, 0) for row in range(8, 12)])
    quarter = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    fronts = torch.stack(
        [boxes.yaw_rad.sin(), torch.zeros_like(boxes.yaw_rad), boxes.yaw_rad.cos()], dim=-1
    )
    there = boxes.is_object[0]
    assert len(boxes.yaw_rad[0, there].unique()) > 1 and boxes.yaw_rad.abs().max() <= np.pi + 1e-6
    for turn in range(4):
        wanted = fronts[0] @ torch.linalg.matrix_power(quarter, turn).T
        np.testing.assert_allclose(fronts[turn, there], wanted[there], atol=1e-6)


def test_four_quarters_are_none(torch_rng):
    boxes_m = torch.rand(5, 3, 6, generator=torch_rng)
    again = boxes_m
    for _ in range(4):
        again = turn_boxes(again, torch.ones(5, dtype=torch.long))
    assert torch.equal(again, boxes_m)
    assert torch.equal(turn_boxes(boxes_m, torch.full((5,), 3)), turn_boxes(
        turn_boxes(boxes_m, torch.full((5,), 2)), torch.full((5,), 1)
    ))  # fmt: skip


def test_a_process_without_a_room_of_its_own_gets_nothing_in_no_room(toy_shards):
    batch = TruthDataset(toy_shards, "train").__getitems__([(3, BLANK)])
    assert batch.room_ids == () and not batch.is_object.any() and not batch.object_class.any()


def test_shards_without_ground_truth_are_a_sentence(toy_shards, tmp_path):
    blind = shutil.copytree(toy_shards, tmp_path / "blind")
    with h5py.File(blind / "train" / "part_000.h5", "r+") as file:
        del next(iter(file["rooms"].values()))["ground_truth"]
    with pytest.raises(
        ShardError, match=r"part_000.h5, room toy/train_00 carries no 3D ground truth"
    ):
        TruthDataset(blind, "train")
    with h5py.File(toy_shards / "train" / "part_001.h5") as file:
        assert "ground_truth" in next(iter(file["rooms"].values()))
    odd = shutil.copytree(toy_shards, tmp_path / "odd")
    with h5py.File(odd / "train" / "part_001.h5", "r+") as file:
        file.attrs["label_set"] = "scannet"
    with pytest.raises(ShardError, match="is labelled 'scannet' but its neighbours 'front3d_bed"):
        TruthDataset(odd, "train")


def test_only_baselines_with_3d_supervision_come_to_the_ground_truth():
    """By name, over the whole package: evaluation reads it; retrieval asks it for the classes of
    CAD models, not for rooms; and of training one module for methods that make rooms, and one for
    those that answer images, which takes meshes by way of evaluation."""
    readers, importers, of_meshes = set(), set(), set()
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and node.attr == "read_ground_truth":
                readers.add(name)
            if (
                isinstance(node, ast.ImportFrom)
                and node.module == "sceneprior.baselines.true_boxes"
            ):
                importers.add(name)
            if (
                isinstance(node, ast.ImportFrom)
                and node.module == "sceneprior.evaluation.ground_truth"
                and name.split("/")[0] in ("data", "models", "losses", "training", "baselines")
            ):
                of_meshes.add(name)
            if isinstance(node, ast.ImportFrom) and str(node.module).endswith("single_view.truth"):
                of_meshes.add(f"{name} (views)")
    assert readers == {
        "baselines/true_boxes.py", "evaluation/ground_truth.py", "generation/cad_models.py"
    }  # fmt: skip
    assert importers == {"baselines/box_training.py"}
    assert of_meshes == {
        "baselines/single_view/truth.py",
        "baselines/single_view/total3d.py (views)",
        "baselines/single_view/im3d.py (views)",
    }


@pytest.mark.parametrize("one_stage", [False, True])
def test_stages_under_2d_supervision_never_ask_for_it(toy_shards, tmp_path, monkeypatch, one_stage):
    from sceneprior.training.fit import fit

    def refuse(self, room_id):
        raise AssertionError(f"the ground truth of {room_id} was opened")

    monkeypatch.setattr(Shard, "read_ground_truth", refuse)
    config = tiny_config(toy_shards, layout__epochs=1, shape__epochs=1)
    if one_stage:
        config = config.model_copy(update={"layout": None})
    fit(config, tmp_path / "run", trainer_options={"accelerator": "cpu"})
    with pytest.raises(AssertionError, match="the ground truth of toy/train_00 was opened"):
        fit(
            tiny_baseline(toy_shards, "atiss"),
            tmp_path / "other",
            trainer_options={"accelerator": "cpu"},
        )

"""Evaluation of a prior in training: what is scored, against which rooms, and what is drawn."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_runs import OCCUPANCY, tiny_config

from sceneprior.classes import class_colors, label_set
from sceneprior.config import load_run
from sceneprior.errors import InputError
from sceneprior.evaluation.ground_truth import reference_scenes
from sceneprior.evaluation.metrics.contents import category_kl, object_counts
from sceneprior.evaluation.metrics.overlaps import overlap_pairs
from sceneprior.experiments.evaluate_samples import (
    TILE_PX,
    SampleEvaluator,
    mask_iou_of_rooms,
    tile,
)
from sceneprior.generation.decode import decode_training_rooms, synthesize
from sceneprior.geometry.meshes import place
from sceneprior.topdown import box_mesh
from sceneprior.views import DecodedScenes


@pytest.fixture(scope="module")
def trained(toy_run):
    return load_run(toy_run)


def test_samples_score_what_eval_would_score(trained, toy_shards, tmp_path):
    toy_shards = shutil.copytree(toy_shards, tmp_path / "with_val")
    shutil.copytree(toy_shards / "test", toy_shards / "val")
    config = tiny_config(toy_shards, samples={"every": 1, "count": 12, "seed": 7})
    result = SampleEvaluator(config)(trained)
    generated = synthesize(trained, 12, 7)
    tracked = reference_scenes(toy_shards, "val", tracked_only=True)
    assert result.against == "val"
    counts, wanted = object_counts(generated).mean(), object_counts(tracked).mean()
    assert result.scores["category_kl"] == pytest.approx(category_kl(generated, tracked))
    assert result.scores["objects"] == counts
    assert result.scores["objects_off"] == pytest.approx(abs(counts - wanted) / wanted)
    assert result.scores["overlaps"] == overlap_pairs(generated)
    decoded = overlap_pairs(decode_training_rooms(trained))
    assert result.scores["overlaps_decoded"] == decoded
    assert 0 < result.scores["mask_iou"] < 1
    assert result.picture.shape == (3 * TILE_PX, 4 * TILE_PX, 3)
    again = SampleEvaluator(config)(trained)
    assert again.scores == result.scores and np.array_equal(again.picture, result.picture)


def test_training_rooms_stand_in_where_there_are_no_val_rooms(trained, toy_shards):
    """Never the test rooms, which the toy shards have."""
    samples = {"every": 1, "count": 4}
    there = SampleEvaluator(tiny_config(toy_shards, samples=samples))(trained)
    asked = SampleEvaluator(tiny_config(toy_shards, samples={**samples, "against": "train"}))(
        trained
    )
    assert there.against == asked.against == "train" and there.scores == asked.scores


def test_rooms_decoded_as_they_are_have_the_masks_that_were_seen(toy_run, toy_shards, monkeypatch):
    """Toy rooms are boxes; with boxes for a template only pixels on edges may differ."""
    cube = box_mesh((0.0, 0.0, 0.0), (2.0, 2.0, 2.0))
    trained = load_run(toy_run)  # its own, since it is changed
    shape = trained.prior.shape
    shape.template = torch.from_numpy(cube.vertices_m).float()
    shape.faces = torch.from_numpy(cube.faces)
    config = tiny_config(toy_shards, seed=0, samples={"every": 1}, data__mask_step=1)
    views = SampleEvaluator(config)._views
    truth = {scene.name: scene for scene in reference_scenes(toy_shards, "train", None, True)}
    rooms, slots = len(views.room_ids), 6
    logits = torch.zeros(rooms, slots, len(label_set("front3d_bedroom")))
    centers, sizes = torch.zeros(rooms, slots, 3), torch.full((rooms, slots, 3), 0.1)
    for row, name in enumerate(views.room_ids):
        scene = truth[name]
        count = len(scene.objects)
        # In another order than the tracks': matching has to find it out.
        centers[row, :count] = torch.from_numpy(scene.centers_m).float().flip(0)
        sizes[row, :count] = torch.from_numpy(scene.sizes_m).float().flip(0)
        logits[row, range(count), scene.class_indices[::-1].copy()] = 5

    def iou(stage, centers):
        def decode(logits_, with_shape):
            template = shape.template.expand(rooms, slots, -1, -1)
            vertices = place(template, centers, sizes) if with_shape else None
            return DecodedScenes(logits, centers, sizes, torch.ones(rooms, slots), None, vertices)

        monkeypatch.setattr(trained.prior, "forward", decode)
        return mask_iou_of_rooms(replace(trained, stage=stage), views)

    for stage in ("layout", "shape"):
        assert iou(stage, centers) > 0.95
        assert iou(stage, centers + 0.5) < 0.5


def test_the_picture_has_a_tile_a_room_in_its_classes_colours(trained):
    scenes = synthesize(trained, 5, 0)
    picture = tile(scenes)
    assert picture.shape == (2 * TILE_PX, 4 * TILE_PX, 3)
    assert (picture[TILE_PX:, TILE_PX:] == 255).all()  # the second row holds one
    colors = class_colors(len(label_set("front3d_bedroom")))
    known = {tuple(color) for color in [*colors, *(colors // 2), (255, 255, 255), (127, 127, 127)]}
    assert {tuple(color) for color in picture.reshape(-1, 3)} <= known


def test_grids_have_no_masks_to_compare(grid_prior, toy_shards):
    config = tiny_config(toy_shards, samples={"every": 1, "count": 4}, **OCCUPANCY)
    found = SampleEvaluator(config)(grid_prior)
    assert "overlaps_decoded" in found.scores and "mask_iou" not in found.scores
    samples = {"every": 1, "metric": "mask_iou"}
    with pytest.raises(InputError, match=r"compares masks of meshes, but model.shape is occupancy"):
        SampleEvaluator(tiny_config(toy_shards, samples=samples, **OCCUPANCY))


def test_a_metric_that_the_label_set_lacks_is_a_sentence(toy_shards):
    samples = {"every": 1, "metric": "type_share"}
    with pytest.raises(InputError, match=r"samples.metric is type_share, but scannet mixes room"):
        SampleEvaluator(tiny_config(toy_shards, label_set="scannet", samples=samples))

"""USL, Total3D and Im3D: their inputs, boxes and shapes, and what other masks change."""

import math
from dataclasses import replace

import pytest
import torch
from tiny_runs import tiny_baseline
from torch.testing import assert_close

from sceneprior.apps.config import load_any_run
from sceneprior.apps.reconstruction.reconstruct import reconstruct
from sceneprior.baselines.single_view.detections import detections_of, some_views
from sceneprior.baselines.single_view.detector import (
    BIN,
    BINS,
    NEAREST_M,
    Estimate,
    TrueObjects,
    TrueViewDataset,
    estimate_losses,
    true_objects,
)
from sceneprior.baselines.single_view.im3d import LEVEL, STEEP, occupancy_logits
from sceneprior.baselines.single_view.usl import silhouette_loss
from sceneprior.core.boxes import turn_vectors
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.views import SceneViews, images_of_split
from sceneprior.training.method import TrainedReconstructor


@pytest.fixture(scope="module")
def views(toy_shards) -> SceneViews:
    """Four views of each of five toy rooms."""
    data = ViewDataset(toy_shards, "train", views_per_room=4, mask_step=2, seed=1)
    return data.__getitems__([(row, 0) for row in range(5)])


def moved(views: SceneViews, quarter: int, shift_m: tuple[float, float]) -> SceneViews:
    """Rooms and cameras together turned by quarters, then moved along the floor."""
    quarters = torch.full((len(views.room_index),), quarter)
    poses = views.world_to_camera
    turned = turn_vectors(poses[..., :3], quarters)
    shift = torch.tensor([shift_m[0], 0.0, shift_m[1]])
    offset = poses[..., 3:].clone()
    offset[..., :3, 0] -= turned[..., :3, :] @ shift
    return replace(views, world_to_camera=torch.cat([turned, offset], dim=-1))


def test_what_is_told_moves_and_turns_with_the_room(views):
    plain = detections_of(views)
    for quarter in range(4):
        other = detections_of(moved(views, quarter, (3.0, -2.0)))
        assert_close(other.crops, plain.crops, rtol=0, atol=1e-5)
        assert_close(other.numbers, plain.numbers, rtol=0, atol=1e-5)
        offsets = torch.full((len(plain), 2), 0.1)
        distances = torch.linspace(1, 4, len(plain))
        before, after = (each.centers_at(offsets, distances) for each in (plain, other))
        turns = torch.full((len(plain),), quarter)
        wanted = turn_vectors(before, turns) + torch.tensor([3.0, 0.0, -2.0])
        assert_close(after, wanted, rtol=0, atol=1e-4)


def test_offsets_and_distances_are_where_centers_are(views):
    found = detections_of(views)
    offsets = torch.linspace(-0.4, 0.4, 2 * len(found)).reshape(-1, 2)
    distances = torch.linspace(0.8, 6, len(found))
    again = found.offsets_and_distances(found.centers_at(offsets, distances))
    assert again[2].all()
    assert_close(again[0], offsets, rtol=0, atol=1e-3)
    assert_close(again[1], distances, rtol=0, atol=1e-4)
    behind = found.eye_m - (found.centers_at(offsets, distances) - found.eye_m)
    offsets, _, ahead = found.offsets_and_distances(behind)
    assert not ahead.any() and not offsets.any()


@pytest.fixture(scope="module")
def batch(toy_shards):
    data = TrueViewDataset(toy_shards, "train", views_per_room=3, mask_step=2, seed=4)
    return data.__getitems__([(row, 0) for row in (0, 3, 5, 7)])


@pytest.fixture
def stage(toy_shards, request):
    config = tiny_baseline(toy_shards, request.param)
    return config.build(config.open_rooms(), None)


def perfect_estimate(true: TrueObjects) -> Estimate:
    offsets, log_distances, log_sizes = true.boxes
    place = (log_distances - math.log(NEAREST_M)) / BIN
    bins = place.long().clamp(0, BINS - 1)
    logits = 20 * torch.nn.functional.one_hot(bins, BINS).float()
    residuals = (place - bins - 0.5).unsqueeze(-1).expand(-1, BINS)
    return Estimate(offsets, log_sizes, logits, residuals)


def test_true_numbers_give_the_true_boxes_and_no_loss(batch):
    found = detections_of(batch.views)
    true = true_objects(found, batch)
    estimate = perfect_estimate(true)
    assert true.ahead.sum() > 10
    for boxes in (true.boxes, estimate.boxes()):
        made = boxes.in_room(found)
        assert_close(
            made.centers_m[true.ahead], true.placed.centers_m[true.ahead], rtol=0, atol=1e-3
        )
        assert_close(made.sizes_m, true.placed.sizes_m, rtol=0, atol=1e-4)
    wrong = estimate_losses(found, estimate._replace(log_sizes=estimate.log_sizes + 0.3), true)
    assert float(wrong["size"]) == pytest.approx(0.3**2 / 2, rel=1e-3)


@pytest.mark.parametrize("stage", ("total3d", "im3d"), indirect=True)
def test_masks_hear_of_their_own_image_alone(batch, stage):
    prior = stage.prior.eval()
    views = some_views(batch.views, slice(1))
    together = prior.find(views)
    alone = prior.find(views.changed(lambda tensor: tensor[1:2]))[0]
    assert len(alone) == len(together[1]) > 1
    for one, other in zip(alone, together[1], strict=True):
        assert one.center_m == pytest.approx(other.center_m, abs=1e-4)
        assert one.size_m == pytest.approx(other.size_m, abs=1e-4)
    fewer = views.visible.clone()
    fewer[1, 0, int(views.visible[1, 0].nonzero()[0])] = False
    less = prior.find(replace(views, visible=fewer))
    changed = [a.center_m != b.center_m for a, b in zip(less[1], together[1][1:], strict=True)]
    assert any(changed), "a neighbour that is gone is missed"
    assert less[0][0].center_m == pytest.approx(together[0][0].center_m, abs=1e-4)


def test_occupancy_is_the_definition(torch_rng):
    blobs = torch.randn(2, 5, 7, generator=torch_rng, dtype=torch.float64) * 0.5
    points = torch.rand(2, 9, 3, generator=torch_rng, dtype=torch.float64) * 2 - 1
    found = occupancy_logits(blobs, points)
    for i in range(2):
        for j in range(9):
            total = 0.0
            for place, log_radii, log_weight in zip(
                *blobs[i].split([3, 3, 1], dim=-1), strict=True
            ):
                scaled = (points[i, j] - place) / log_radii.exp()
                total += float(log_weight.exp() * torch.exp(-(scaled**2).sum() / 2))
            assert float(found[i, j]) == pytest.approx(STEEP * (total - LEVEL), abs=1e-9)


def test_what_stands_behind_another_object_costs_nothing(views):
    ids = views.observed_ids
    objects = torch.arange(1, 1 + views.is_object.shape[1])[:, None, None]
    perfect = (ids.unsqueeze(2) == objects).float()
    seen = views.visible
    assert float(silhouette_loss(perfect, views, seen)) < 1e-5
    everywhere_else = ((ids.unsqueeze(2) != objects) & (ids.unsqueeze(2) > 0)).float()
    assert float(silhouette_loss(perfect + everywhere_else, views, seen)) < 1e-5
    background = (ids == 0).unsqueeze(2).float().expand_as(perfect)
    assert float(silhouette_loss(perfect + background, views, seen)) > 0.3


@pytest.mark.parametrize("method", ("usl", "total3d", "im3d"))
def test_a_run_answers_each_mask_in_order(baseline_run, toy_shards, method):
    run = baseline_run(method)
    trained = load_any_run(run)
    assert isinstance(trained, TrainedReconstructor) and not trained.remembers_rooms
    images, _ = images_of_split(toy_shards, "test")
    answers = reconstruct(trained, images)
    again = reconstruct(load_any_run(run), images[:1])[0]
    assert again.scene.objects[0].center_m == pytest.approx(
        answers[0].scene.objects[0].center_m, abs=1e-4
    )
    for image, answer in zip(images, answers, strict=True):
        assert answer.image is image and answer.score >= 0
        assert (answer.scene.class_indices == image.object_class).all()
        for item in answer.scene.objects:
            assert min(item.size_m) > 0 and item.mesh is not None
            assert torch.isfinite(torch.tensor(item.mesh.vertices_m)).all()

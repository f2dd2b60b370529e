"""Total3D and Im3D: their numbers make boxes, what they hear of each other, their shapes."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_runs import tiny_baseline
from torch.testing import assert_close

from sceneprior.baselines.single_view.detections import detections_of, some_views
from sceneprior.baselines.single_view.im3d import LEVEL, STEEP, occupancy_logits, overlap_loss
from sceneprior.baselines.single_view.network import Placed
from sceneprior.baselines.single_view.total3d import (
    BIN,
    BINS,
    NEAREST_M,
    Estimate,
    TrueObjects,
    estimate_losses,
    mesh_losses,
    true_objects,
)
from sceneprior.baselines.single_view.truth import TrueViewDataset, filled
from sceneprior.core.meshes import icosphere

METHODS = ("total3d", "im3d")


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
    if true.ahead.all():
        losses = estimate_losses(found, estimate, true)
        assert max(float(loss) for loss in losses.values()) < 1e-3
    wrong = estimate_losses(found, estimate._replace(log_sizes=estimate.log_sizes + 0.3), true)
    assert float(wrong["size"]) == pytest.approx(0.3**2 / 2, rel=1e-3)


@pytest.mark.parametrize("stage", METHODS, indirect=True)
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


@pytest.mark.parametrize("stage", METHODS, indirect=True)
def test_every_weight_learns_and_a_few_rooms_are_learnt(batch, stage):
    losses = []
    stage.total = lambda terms, weights, views: sum(
        weights.get(name, 1.0) * term for name, term in terms.items()
    )
    optimizer = torch.optim.Adam(stage.prior.parameters(), lr=3e-3)
    for step in range(40):
        torch.manual_seed(step)
        loss = stage.training_step(batch, step)
        optimizer.zero_grad()
        loss.backward()
        if step == 2:
            still = [n for n, p in stage.prior.named_parameters() if not p.grad.abs().sum() > 0]
            assert still == []
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-5:]) < 0.7 * sum(losses[:5])


def test_what_a_surface_encloses_is_filled_and_what_it_does_not_is_empty():
    top = np.random.default_rng(0).uniform(-1, 1, (20000, 3)) * (1, 0.1, 1) + (0, 0.9, 0)
    legs = np.random.default_rng(1).uniform(-1, 1, (20000, 3)) * (0.1, 1, 0.1)
    corners = np.array([[x, 0, z] for x in (-0.9, 0.9) for z in (-0.9, 0.9)])
    table = filled(np.concatenate([top, *(legs + corner for corner in corners)]), 16)
    assert table[:, -1].all() and table[0, :, 0].all()
    assert not table[2:-2, :13, :].any() and not table[:, :13, 2:-2].any()


def test_a_mesh_on_the_surface_costs_its_edges_alone():
    vertices, faces = icosphere(1)
    losses = mesh_losses(vertices[None], faces, vertices[None, torch.randperm(len(vertices))])
    assert float(losses["chamfer"]) == 0 and float(losses["edges"]) > 0
    apart = mesh_losses(vertices[None], faces, 1.5 * vertices[None])
    assert float(apart["chamfer"]) == pytest.approx(2 * 0.25, rel=1e-3)


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


def test_objects_inside_one_another_move_apart(batch):
    found = detections_of(some_views(batch.views.changed(lambda tensor: tensor[:1]), slice(1)))
    count = len(found)
    assert count > 1
    centers_m = torch.zeros(count, 3)
    centers_m[:, 0] = 0.3 * torch.arange(count)
    centers_m.requires_grad_()
    blobs = torch.zeros(count, 1, 7)  # one Gaussian in the middle of each
    loss = overlap_loss(found, Placed(centers_m, torch.ones(count, 3)), blobs)
    loss.backward()
    assert float(loss) > 0
    assert centers_m.grad[0, 0] > 0 > centers_m.grad[-1, 0]
    far = Placed(20 * centers_m.detach(), torch.ones(count, 3))
    assert float(overlap_loss(found, far, blobs)) == 0
    alone = detections_of(replace(batch.views, visible=torch.zeros_like(batch.views.visible)))
    nothing = Placed(centers_m[:0], centers_m[:0])
    assert float(overlap_loss(alone, nothing, blobs[:0]).detach()) == 0

"""USL: what other views teach, and what they leave alone."""

from dataclasses import replace

import pytest
import torch
from tiny_runs import tiny_baseline

from sceneprior.baselines.single_view.detections import detections_of, some_views
from sceneprior.baselines.single_view.usl import other_view_losses, silhouette_loss
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.overlaps import box_iou_3d


@pytest.fixture(scope="module")
def views(toy_shards):
    data = ViewDataset(toy_shards, "train", views_per_room=5, mask_step=2, seed=2)
    return data.__getitems__([(row, 0) for row in range(4)])


@pytest.fixture
def stage(toy_shards):
    config = tiny_baseline(toy_shards, "usl")
    return config.build(config.open_rooms(), None)


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


def test_an_object_that_no_other_view_shows_teaches_nothing(views, stage):
    found, others = detections_of(some_views(views, slice(1))), some_views(views, slice(1, None))
    faces = stage.prior.shape.faces
    hidden = replace(others, visible=others.visible & (torch.arange(others.visible.shape[2]) != 0))
    losses = other_view_losses(found, *stage.prior(found), faces, hidden, stage.settings)
    sum(losses.values()).backward()
    before = [p.grad.clone() for p in stage.prior.parameters()]
    assert all(torch.isfinite(slope).all() for slope in before)
    nobody = replace(others, visible=torch.zeros_like(others.visible))
    stage.zero_grad()
    losses = other_view_losses(found, *stage.prior(found), faces, nobody, stage.settings)
    assert {name: loss.item() for name, loss in losses.items()} == dict.fromkeys(losses, 0.0)


def test_a_few_rooms_can_be_learnt_from_their_masks_alone(views, stage, toy_shards):
    """A descent: boxes in 3D come right, though none was ever shown."""
    true = {room.name: room for room in reference_scenes(toy_shards, "train", tracked_only=True)}

    def overlap() -> float:
        first = some_views(views, slice(1))
        found = []
        for row, objects in enumerate(stage.prior.find(first)):
            room = true[views.room_ids[row]]
            rows = views.visible[row, 0].nonzero()[:, 0].numpy()
            boxes = [torch.tensor([getattr(o, k) for o in objects]).double().numpy()
                     for k in ("center_m", "size_m")]  # fmt: skip
            found += list(box_iou_3d(room.centers_m[rows], room.sizes_m[rows], *boxes).diagonal())
        return sum(found) / len(found)

    before = overlap()
    optimizer = torch.optim.Adam(stage.prior.parameters(), lr=1e-2)
    found, others = detections_of(some_views(views, slice(1))), some_views(views, slice(1, None))
    faces = stage.prior.shape.faces
    for _ in range(50):
        losses = other_view_losses(found, *stage.prior(found), faces, others, stage.settings)
        loss = 5 * losses["box"] + losses["frustum"] + losses["mask"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    after = overlap()
    assert before < 0.1 and after > 0.2, (before, after)

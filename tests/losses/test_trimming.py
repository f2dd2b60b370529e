"""Trimmed box loss: wrong masks do not move it, and where nothing is trimmed it is the paper's."""

import math

import pytest
import torch
from torch.testing import assert_close

from sceneprior.losses.layout import agreeing_views, box_loss, layout_losses
from sceneprior.losses.matching import match_objects

TRUE_BOX = torch.tensor([0.2, 0.3, 0.5, 0.7], dtype=torch.float64)


def spoilt_views(wrong: int, far: float) -> torch.Tensor:
    """Ten views of one object that never moves; in `wrong` of them its box is `far` to the left."""
    boxes = TRUE_BOX.repeat(1, 10, 1, 1)
    boxes[:, :wrong, :, (0, 2)] -= far
    return boxes


def loss_of(predicted, observed, trim, counted=None):
    clear = torch.ones_like(observed, dtype=torch.bool)
    counted = clear[..., 0] if counted is None else counted
    return box_loss(predicted.expand_as(observed), observed, clear, counted, trim_views=trim)


@pytest.mark.parametrize("trim", [0.0, 0.1, 0.35, 0.9])
def test_the_loop_that_drops_the_furthest_views(batch, trim):
    generator = torch.Generator().manual_seed(1)
    distance = torch.rand(3, 6, 4, generator=generator, dtype=torch.float64)
    counted = batch.views.visible
    kept = agreeing_views(distance, counted, trim)
    for room in range(3):
        for item in range(4):
            seen = [view for view in range(6) if counted[room, view, item]]
            seen.sort(key=lambda view: float(distance[room, view, item]))
            left = len(seen) - math.floor(trim * len(seen))
            wanted = set(seen[:left])
            assert {view for view in range(6) if kept[room, view, item]} == wanted


def test_an_object_seen_once_keeps_its_view():
    counted = torch.tensor([True, False, False]).reshape(1, 3, 1)
    assert torch.equal(agreeing_views(torch.ones(1, 3, 1), counted, 0.9), counted)


@pytest.mark.parametrize("far", [0.05, 0.2])
def test_three_wrong_views_of_ten_cost_nothing_however_wrong_they_are(far):
    observed = spoilt_views(3, far)
    assert loss_of(TRUE_BOX, observed, 0.3).item() == 0
    assert loss_of(TRUE_BOX, observed, 0.0).item() == pytest.approx(0.3 * 2 * far, rel=1e-12)


def test_gradients_are_those_of_the_views_that_are_left(batch):
    counted = batch.views.visible
    start = batch.views.boxes + 0.3 * torch.rand_like(batch.views.boxes)
    start.requires_grad_()

    def loss(predicted):
        clear = batch.views.sides_clear
        return box_loss(predicted, batch.views.boxes, clear, counted, trim_views=0.4)

    assert torch.autograd.gradcheck(loss, (start,))
    (gradient,) = torch.autograd.grad(loss(start), start)
    used = (gradient != 0).any(dim=-1).sum(dim=1)
    count = counted.sum(dim=1)
    assert torch.equal(used, count - (0.4 * count).floor().long())


def test_the_order_of_views_does_not_matter(batch):
    views = batch.views
    turned = torch.arange(5, -1, -1)
    here, there = (
        box_loss(
            batch.boxes.boxes[:, order, :4], views.boxes[:, order], views.sides_clear[:, order],
            views.visible[:, order], 0.3, 0.4,
        )
        for order in (torch.arange(6), turned)
    )  # fmt: skip
    assert_close(here, there, rtol=1e-12, atol=0)


def test_only_the_box_loss_is_trimmed(batch):
    matches = match_objects(batch.scenes, batch.boxes, batch.views)
    plain, trimmed = (
        layout_losses(batch.scenes, batch.boxes, batch.views, matches, trim_views=trim)
        for trim in (0.0, 0.5)
    )
    assert trimmed.pop("box") < plain.pop("box")
    assert {name: float(loss) for name, loss in plain.items()} == {
        name: float(loss) for name, loss in trimmed.items()
    }

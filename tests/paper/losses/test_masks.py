"""The mask term: gate, averages, gradients, certain pixels."""

from dataclasses import replace

import pytest
import torch
from references import losses as by_hand

from sceneprior.core.observations import thinned
from sceneprior.core.proxies import icosphere
from sceneprior.paper.losses import mask_loss, seen_masks
from sceneprior.paper.matching import match_objects
from sceneprior.paper.settings import ShapeConfig


def masks(batch, seed=0, sharp=1.0):
    """Soft masks (rooms, views, slots, 6, 8): the observed ones, blurred and partly wrong. Two
    rooms have void pixels, with ids above their numbers of objects."""
    generator = torch.Generator().manual_seed(seed)
    ids = batch.views.instance_ids
    matches = match_objects(batch.scenes, batch.boxes, batch.views)
    rendered = torch.rand(3, 6, 5, 6, 8, generator=generator, dtype=torch.float64)
    for room, item in matches.valid.nonzero().tolist():
        slot = int(matches.prediction[room, item])
        for view in range(0, 6, 2):  # every other view overlaps
            mine = (ids[room, view] == item + 1).double()
            rendered[room, view, slot] = 0.15 * rendered[room, view, slot] + 0.8 * mine
    return rendered, matches


@pytest.mark.parametrize("gate", [0.0, 0.3, 0.5, 0.99])
def test_the_mask_loss_is_its_loop(batch, gate):
    """A pair that fails the gate counts as 0; with `passing_only`, it does not count."""
    rendered, matches = masks(batch)
    views = batch.views
    loss, log = mask_loss(rendered, views, matches, gate)
    released, _ = mask_loss(rendered, views, matches, gate, passing_only=True)
    objects, ious, used, passing = [], [], 0, []
    for room, item in matches.valid.nonzero().tolist():
        slot = int(matches.prediction[room, item])
        each = []
        for view in views.visible[room, :, item].nonzero()[:, 0].tolist():
            known = views.instance_ids[room, view] <= int(views.is_object[room].sum())
            mine = (rendered[room, view, slot] * known).tolist()
            observed = (views.instance_ids[room, view] == item + 1).tolist()
            ious.append(by_hand.iou(mine, observed))
            passed = ious[-1] > gate
            used += passed
            each.append(by_hand.mask_cross_entropy(mine, observed) if passed else 0.0)
            passing += each[-1:] * passed
        objects.append(sum(each) / len(each))
    assert float(loss) == pytest.approx(sum(objects) / len(objects), rel=1e-6)
    assert float(released) == pytest.approx(sum(passing) / max(len(passing), 1), rel=1e-6)
    assert float(log["mask_iou"]) == pytest.approx(sum(ious) / len(ious), rel=1e-9)
    assert float(log["mask_used"]) == pytest.approx(used / len(ious))
    assert {0.0: used == len(ious), 0.99: used == 0}.get(gate, 0 < used < len(ious))


def test_what_a_prediction_covers_of_void_is_neither_punished_nor_rewarded(batch):
    rendered, matches = masks(batch)
    ids = torch.where(batch.views.instance_ids == 0, 99, batch.views.instance_ids)
    views = replace(batch.views, instance_ids=ids)
    void = ids > views.is_object.sum(dim=1)[:, None, None, None]
    found = []
    for over_void in (0.0, 0.6, 1.0):
        drawn = rendered.where(~void[:, :, None], over_void).requires_grad_()
        loss, log = mask_loss(drawn, views, matches, 0.3)
        (slope,) = torch.autograd.grad(loss, drawn)
        assert slope.any() and not (slope * void[:, :, None]).any()
        found.append([float(value) for value in (loss.detach(), *log.values())])
    assert found[0] == found[1] == found[2]


def test_mask_loss_passes_gradcheck(batch):
    rendered, matches = masks(batch)
    rendered = rendered.clamp(0.02, 0.98)

    def loss_of(corner):  # of every mask: all its pixels enter alike, and would take 7 s
        whole = rendered.clone()
        whole[..., :2, :3] = corner
        return mask_loss(whole, batch.views, matches, 0.3)[0]

    corner = rendered[..., :2, :3].clone().requires_grad_()
    assert torch.autograd.gradcheck(loss_of, (corner,), eps=1e-7, atol=1e-6)


def test_certain_masks_pull_no_harder_than_doubtful_ones(batch):
    """If a float32 mask is rounded to 0 or 1 and wrong, torch alone has a gradient of 1e12."""
    rendered, matches = masks(batch)
    for value in (0.0, 1.0):
        certain = rendered.float()
        certain[..., :1, :1] = value
        leaf = certain.requires_grad_()
        loss, _ = mask_loss(leaf, batch.views, matches, 0.0)
        loss.backward()
        assert not leaf.grad[..., :1, :1].any()
        # Other pixels: rendered between 0 and 0.95 of a number from torch.rand.
        assert 0 < leaf.grad.abs().max() < 10


@pytest.mark.parametrize("step", [1, 2, 3, 4, 6])
def test_sharp_masks_are_the_thinned_pixels_of_whole_ones(batch, step):
    unit, faces = icosphere(1)
    vertices_m = batch.scenes.centers_m[:, :, None] + 0.6 * unit
    settings, every = ShapeConfig(epochs=1, sigma_px2=1e-9), (..., *thinned(step))
    found = []
    whole = torch.zeros(3, 6, *batch.views.image_size, dtype=torch.int64)
    for each, ids in ((1, whole), (step, whole[every])):
        views = replace(batch.views, instance_ids=ids, mask_step=each)
        found.append(seen_masks(vertices_m, faces, views, settings) > 0.5)
    assert 0.005 < found[1].double().mean() < 0.5
    assert torch.equal(found[1], found[0][every])

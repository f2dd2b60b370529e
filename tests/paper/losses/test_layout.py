"""The layout terms against loops in Python floats, and their gradients against differences."""

from dataclasses import replace

import pytest
import torch
from references import losses as by_hand
from torch.nn import functional as F

from sceneprior.core.boxes import box_corners
from sceneprior.core.cameras import boxes_of_points
from sceneprior.paper.losses import (
    box_loss,
    class_loss,
    completeness_loss,
    completeness_targets,
    frustum_loss,
    kept_objects,
    layout_losses,
    take,
)
from sceneprior.paper.matching import match_objects
from sceneprior.paper.settings import LossConfig
from sceneprior.training.steps import weighted_sum

OVERSHOOT = (1.0, 0.3)


@pytest.mark.parametrize("overshoot", OVERSHOOT)
def test_all_four_terms_are_their_loops(batch, overshoot):
    views, scenes = batch.views, batch.scenes
    weights = LossConfig(occlusion_slack=overshoot)
    losses, matches = layout_losses(scenes, batch.boxes, views, weights, "first_n")
    slot = matches.prediction.tolist()
    valid = matches.valid.tolist()
    visible, inside = views.visible.tolist(), batch.boxes.in_frustum.tolist()
    rooms, count, items = range(3), range(6), range(4)
    box_counted = [
        [[visible[r][v][k] and valid[r][k] and inside[r][v][slot[r][k]] for k in items]
         for v in count] for r in rooms
    ]  # fmt: skip
    ray_counted = [
        [[visible[r][v][k] and valid[r][k] and not inside[r][v][slot[r][k]] for k in items]
         for v in count] for r in rooms
    ]  # fmt: skip
    assert str(box_counted).count("True") > 5 and str(ray_counted).count("True") > 5
    predicted, observed = batch.boxes.boxes.tolist(), views.boxes.tolist()
    clear = views.sides_clear.tolist()
    centers, poses = scenes.centers_m.tolist(), views.world_to_camera.tolist()
    intrinsics = views.intrinsics.tolist()

    def box(r, v, k):
        return by_hand.box_distance(
            predicted[r][v][slot[r][k]], observed[r][v][k], clear[r][v][k], overshoot
        )

    def ray(r, v, k):
        x1, y1, x2, y2 = observed[r][v][k]
        middle = ((x1 + x2) / 2 * 32, (y1 + y2) / 2 * 24)
        return by_hand.frustum_angle(centers[r][slot[r][k]], poses[r][v], intrinsics[r][v], middle)

    logits = scenes.class_logits.tolist()
    wanted = {
        "class": by_hand.class_loss(
            [[logits[r][slot[r][k]] for k in items] for r in rooms],
            views.object_class.tolist(),
            valid,
        ),
        "box": by_hand.mean_of_objects(box, box_counted),
        "completeness": by_hand.completeness_loss(scenes.completeness_logits.tolist(), (4, 2, 3)),
        "frustum": by_hand.mean_of_objects(ray, ray_counted),
    }
    assert list(losses) == list(wanted)
    for name, loss in losses.items():
        assert float(loss) == pytest.approx(wanted[name], rel=1e-12), name


def test_stop_flags_count_up_to_the_fullest_room(batch):
    """Four of the five predictions: the fullest room holds four objects."""
    logits, targets = batch.scenes.completeness_logits, ((0, 0, 0, 1), (0, 1, 1, 1), (0, 0, 1, 1))
    wanted = [
        F.binary_cross_entropy_with_logits(logits[room, k], logits.new_tensor(target))
        for room, row in enumerate(targets)
        for k, target in enumerate(row)
    ]
    found = completeness_loss(batch.scenes, batch.views, "stop")
    assert float(found) == pytest.approx(float(sum(wanted)) / 12, rel=1e-12)


def test_the_weights_of_the_losses_are_those_of_section_4():
    terms = {"class": 1.0, "box": 10.0, "completeness": 100.0, "frustum": 1e3, "mask": 1e4}
    losses = {name: torch.tensor(value) for name, value in terms.items()}
    assert float(weighted_sum(losses, LossConfig())) == 1 + 5 * 10 + 100 + 1000 + 2 * 10000
    per_room = {name: torch.tensor([value, 0.0]) for name, value in losses.items()}
    assert weighted_sum(per_room, LossConfig(box=0.5)).tolist() == [21106.0, 0.0]


def test_nothing_seen_is_zero_loss_not_nan(batch):
    none = torch.zeros_like(batch.views.visible)
    views = replace(batch.views, visible=none)
    scenes = replace(batch.scenes, centers_m=batch.scenes.centers_m.clone().requires_grad_())
    losses, _ = layout_losses(scenes, batch.boxes, views, LossConfig(), "first_n")
    assert losses["class"] == losses["box"] == losses["frustum"] == 0
    losses["frustum"].backward()
    assert (scenes.centers_m.grad == 0).all()


def test_every_layout_term_passes_gradcheck(batch):
    """With the matches held fixed, as in a training step."""
    views = batch.views
    matches = match_objects(batch.scenes, batch.boxes, views)
    seen = views.visible & matches.valid[:, None]

    def boxes(centers, sizes):
        corners = box_corners(centers, sizes)
        return boxes_of_points(corners, views.world_to_camera, views.intrinsics, views.image_size)

    def box(centers, sizes):
        found = boxes(centers, sizes)
        predicted = take(found.boxes, matches.prediction, 2)
        inside = take(found.in_frustum, matches.prediction, 2)
        return box_loss(predicted, views.boxes, views.sides_clear, seen & inside, 0.3)

    def frustum(centers):
        return frustum_loss(take(centers, matches.prediction, 1), views, seen)

    def classes(logits):
        return class_loss(replace(batch.scenes, class_logits=logits), views.object_class, matches)

    def completeness(logits):
        return completeness_loss(
            replace(batch.scenes, completeness_logits=logits), views, "first_n"
        )

    scenes = batch.scenes
    for term, inputs in (
        (box, (scenes.centers_m, scenes.sizes_m)),
        (frustum, (scenes.centers_m,)),
        (classes, (scenes.class_logits,)),
        (completeness, (scenes.completeness_logits,)),
    ):
        leaves = tuple(value.clone().requires_grad_() for value in inputs)
        (gradient,) = torch.autograd.grad(term(*leaves), leaves[:1])
        assert gradient.abs().max() > 1e-4, term.__name__
        assert torch.autograd.gradcheck(term, leaves, eps=1e-7, atol=1e-6), term.__name__


def test_the_two_conventions_written_out():
    """Targets keep the real objects; one word of a scene counts. `stop` has no empty rooms."""
    for convention, targets, kept in (
        ("first_n", [[0, 0, 0, 0], [1, 0, 0, 0], [1, 1, 1, 0]], [[1, 1, 0, 0], [0, 0, 0, 0]]),
        ("stop", [[1, 1, 1, 1], [1, 1, 1, 1], [0, 0, 1, 1]], [[1, 0, 0, 0], [1, 1, 1, 0]]),
    ):
        counts = torch.tensor([0, 1, 3])
        found = completeness_targets(counts, 4, convention)
        assert found.int().tolist() == targets
        least = counts.clamp(min=int(convention == "stop"))
        back = kept_objects(found.float() * 2 - 1, convention)
        assert torch.equal(back, torch.arange(4) < least[:, None])
        logits = torch.tensor([[2.0, 0.1, -0.1, 5.0], [-1, -2, 3, -1]])
        assert kept_objects(logits, convention).int().tolist() == kept
    assert kept_objects(-torch.ones(1, 4), "stop").all()  # nobody says stop

"""Losses of the GAN's generator and discriminator beside the maps: values and gradients."""

import math

import pytest
import torch
from torch.testing import assert_close

from sceneprior.baselines.gan.losses import (
    AREA,
    CEILING_M,
    MARGIN_M,
    SIZES_M,
    VARIED,
    adversarial_loss,
    bounds_penalty,
    contents,
    diversity_loss,
)
from sceneprior.core.cameras import camera_centers
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.views import DecodedScenes


def scenes_of(boxes: torch.Tensor) -> DecodedScenes:
    """Scenes with these centres and sizes; nothing else of them is asked for."""
    return DecodedScenes(boxes, boxes[..., :3], boxes[..., 3:], boxes[..., 0], None, None)


def test_the_loss_is_cross_entropy(torch_rng):
    patches = torch.randn(3, 2, 4, 5, generator=torch_rng, dtype=torch.float64)
    rooms = torch.randn(3, generator=torch_rng, dtype=torch.float64)
    for real in (True, False):
        wanted = sum(
            torch.nn.functional.binary_cross_entropy(
                score.sigmoid(), torch.full_like(score, float(real))
            )
            for score in (patches, rooms)
        )
        assert_close(adversarial_loss((patches, rooms), real), wanted, rtol=0, atol=1e-12)


def test_contents_are_counts_and_shares_of_the_views(torch_rng):
    maps = torch.rand(2, 3, 4, 5, 6, generator=torch_rng, dtype=torch.float64).softmax(dim=2)
    counts = torch.tensor([[0.0, 1, 2, 0], [0, 0, 0, 5]], dtype=torch.float64)
    said = contents(maps, counts)
    assert torch.equal(said[:, :4], counts)
    assert_close(said[:, 4:].sum(dim=1), torch.full((2,), float(AREA), dtype=torch.float64))
    for room in range(2):
        for label in range(4):
            every = [float(maps[room, view, label].mean()) for view in range(3)]
            assert said[room, 4 + label].item() == pytest.approx(AREA * sum(every) / 3)


def test_what_is_plausible_costs_nothing_and_what_is_not_is_drawn_back(toy_shards):
    views = ViewDataset(toy_shards, "train", views_per_room=3, mask_step=4).__getitems__(
        [(row, 0) for row in range(4)]
    )
    reach_x, _, reach_z = (
        camera_centers(views.world_to_camera).abs().flatten(0, 1).max(dim=0).values + MARGIN_M
    ).tolist()
    fine = torch.tensor([0.0, 0.5, 0, 1, 1, 1]).repeat(4, 2, 1)
    assert bounds_penalty(scenes_of(fine), views) == 0
    entries = fine.numel() / 2 * 3  # of each kind: out of the room, too small, too large
    for axis, value, cost in (
        (0, -reach_x, 0.5),  # half of it is out
        (2, reach_z + 3, 3.5),
        (1, 0.2, 0.3),  # sunk into the floor
        (1, CEILING_M, 0.5),
        (4, SIZES_M[0] / 2, SIZES_M[0] / 2),
        (5, SIZES_M[1] + 1, 1.0),
    ):
        boxes = fine.clone()
        boxes[2, 1, axis] = value
        boxes.requires_grad_()
        told = bounds_penalty(scenes_of(boxes), views)
        assert told.item() * entries == pytest.approx(cost, abs=1e-4)
        told.backward()
        pulled = boxes.grad[2, 1, axis] * math.copysign(1, value - float(fine[2, 1, axis]))
        assert pulled > 0
        assert not boxes.grad[:2].any()


def test_sameness_is_minus_the_mean_log_spread_and_never_without_a_slope(torch_rng):
    numbers = torch.randn(400, 2, 6, generator=torch_rng, dtype=torch.float64)
    numbers = (numbers - numbers.mean(dim=0)) / numbers.std(dim=0, correction=0)
    # That of y has no say, and those of z and height have no more to gain.
    spreads = torch.tensor([0.5, 9, 3, 0.03, 1, 0.3]).double()
    boxes = (numbers * spreads).requires_grad_()

    assert_close(
        diversity_loss(scenes_of(boxes)).item(),
        -math.log(0.5 / VARIED[0] * 0.1) / 5,
        rtol=0,
        atol=1e-3,
    )
    one = torch.ones(3, 2, 6, requires_grad=True)
    expected = -sum(math.log(1e-3 / wanted) for wanted in VARIED) / 5
    assert diversity_loss(scenes_of(one)).item() == pytest.approx(expected, abs=1e-4)
    diversity_loss(scenes_of(one)).backward()
    assert one.grad.isfinite().all()

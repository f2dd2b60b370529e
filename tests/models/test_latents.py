"""The hypersphere: unit vectors in, geodesics along it."""

import math

import pytest
import torch
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.models.latents import LatentSphere, slerp


def test_latents_are_positive_mixtures_of_unit_anchors_on_the_unit_sphere(torch_rng):
    sphere = LatentSphere(7, 12, seed=3)
    assert_close(sphere.anchors.norm(dim=-1), torch.ones(7), rtol=0, atol=1e-6)
    logits = torch.randn(5, 7, generator=torch_rng)
    z = sphere(logits)
    assert_close(z.norm(dim=-1), torch.ones(5), rtol=0, atol=1e-6)
    for room in range(5):
        shares = [math.exp(value) for value in logits[room].tolist()]
        mixed = sum(
            share / sum(shares) * anchor
            for share, anchor in zip(shares, sphere.anchors.double(), strict=True)
        )
        assert_close(z[room].double(), mixed / mixed.norm(), rtol=0, atol=1e-6)


def test_one_overwhelming_logit_is_its_anchor():
    sphere = LatentSphere(7, 12)
    assert_close(sphere(50 * torch.eye(7)), sphere.anchors, rtol=0, atol=1e-6)


def test_a_constant_added_to_all_logits_changes_nothing(torch_rng):
    sphere = LatentSphere(7, 12).double()
    logits = torch.randn(5, 7, generator=torch_rng, dtype=torch.float64)
    assert_close(sphere(logits + 3.5), sphere(logits), rtol=0, atol=1e-14)


def test_anchors_come_from_the_seed_and_travel_with_the_model():
    assert torch.equal(LatentSphere(7, 12, 3).anchors, LatentSphere(7, 12, 3).anchors)
    assert not torch.equal(LatentSphere(7, 12, 3).anchors, LatentSphere(7, 12, 4).anchors)
    assert "anchors" in LatentSphere(7, 12).state_dict()
    assert not list(LatentSphere(7, 12).parameters())


@pytest.mark.parametrize("angle", [1e-8, 1e-4, 0.3, 2.0, 3.1])
def test_slerp_walks_at_equal_angles_on_the_unit_sphere(torch_rng, angle):
    start, other = F.normalize(
        torch.randn(2, 9, generator=torch_rng, dtype=torch.float64), dim=-1
    ).unbind()
    across = F.normalize(other - (other @ start) * start, dim=-1)
    end = math.cos(angle) * start + math.sin(angle) * across
    path = slerp(start, end, 6)
    assert path.shape == (6, 9)
    assert_close(path[0], start, rtol=0, atol=1e-12)
    assert_close(path[-1], end, rtol=0, atol=1e-12)
    assert_close(path.norm(dim=-1), torch.ones(6, dtype=torch.float64), rtol=0, atol=1e-12)
    chords = (path[1:] - path[:-1]).norm(dim=-1)  # 2 sin(step / 2), exact for small angles, too
    assert_close(
        2 * torch.asin(chords / 2), torch.full((5,), angle / 5).double(), rtol=1e-6, atol=0
    )
    # In the plane of the two ends.
    assert (
        path - (path @ start)[:, None] * start - (path @ across)[:, None] * across
    ).abs().max() < (1e-12)


def test_opposite_points_have_no_shortest_path():
    start = F.normalize(torch.ones(4), dim=-1)
    with pytest.raises(ValueError, match="opposite points; any great circle joins them"):
        slerp(start, -start, 3)

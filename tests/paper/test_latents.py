"""The latent spaces: the hypersphere with its geodesics, and the cube of ablation c1."""

import math

import pytest
import torch
from refusals import refused
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.paper.prior import LatentCube, LatentSphere


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


@pytest.mark.parametrize("angle", [1e-8, 1e-4, 0.3, 2.0, 3.1])
def test_slerp_walks_at_equal_angles_on_the_unit_sphere(torch_rng, angle):
    start, other = F.normalize(
        torch.randn(2, 9, generator=torch_rng, dtype=torch.float64), dim=-1
    ).unbind()
    across = F.normalize(other - (other @ start) * start, dim=-1)
    end = math.cos(angle) * start + math.sin(angle) * across
    along = torch.linspace(0, 1, 6, dtype=torch.float64)
    path = LatentSphere(7, 9).between(start, end, along)
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
    with refused("paper/opposite ends"):
        LatentSphere(7, 4).between(start, -start, torch.ones(1))


def test_steps_on_the_sphere(torch_rng):
    sphere = LatentSphere(7, 12).double()
    z = sphere(torch.randn(5, 7, generator=torch_rng, dtype=torch.float64))
    moved = sphere.step(z, 0.3, 4)
    assert torch.equal(moved, sphere.step(z, 0.3, 4))
    assert not torch.equal(moved, sphere.step(z, 0.3, 5))
    assert_close(moved.norm(dim=-1), torch.ones(5, dtype=torch.float64), rtol=0, atol=1e-12)
    assert 0.1 < (moved - z).norm(dim=-1).mean() < 0.5  # steps of about 0.3


def test_a_coordinate_of_the_cube_is_the_normal_distribution_function(torch_rng):
    from scipy.stats import norm

    cube = LatentCube(3)
    logits = torch.randn(4, 3, generator=torch_rng, dtype=torch.float64)
    wanted = 2 * torch.from_numpy(norm.cdf(logits.numpy())) - 1
    assert_close(cube(logits), wanted, rtol=0, atol=1e-12)  # half its edge is sqrt(3 / 3)
    assert torch.autograd.gradcheck(cube, (logits.requires_grad_(),))
    assert not cube.state_dict()

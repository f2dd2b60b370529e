"""Rays through occupancy grids against their loop, their gradients, and special rays."""

import math

import pytest
import torch
from references import rays as by_hand
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.losses.rays import places_in_frame, ray_loss, total_variation
from sceneprior.views import Rays

SAMPLES = 5
MARGIN = 1.1


def random_case(generator, objects=4, count=9, cells=(4, 5, 6), dtype=torch.float64):
    """Grids, boxes and rays from about the boxes, some inside; most of them pass through."""

    def rand(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    logits = 4 * rand(objects, *cells) - 2
    centers, sizes = 2 * rand(objects, 3) - 1, 0.4 + rand(objects, 3)
    origins = centers[:, None] + 4 * rand(objects, count, 3) - 2
    origins[:, 0] = centers  # a camera inside
    aims = centers[:, None] + sizes[:, None] * (rand(objects, count, 3) - 0.5)
    directions = F.normalize(aims - origins, dim=-1)
    until = torch.full((objects, count), torch.inf, dtype=torch.float64)
    until[:, 1] = 0  # says nothing
    until[:, 2] = (origins[:, 2] - centers).norm(dim=-1)  # known up to the middle
    rays = Rays(origins, directions, rand(objects, count) > 0.5, until)
    rays = Rays(*(part.to(dtype) if part.is_floating_point() else part for part in rays))
    offsets = rand(objects, count)
    return *(part.to(dtype) for part in (logits, centers, sizes)), rays, offsets.to(dtype)


def loss_by_hand(logits, centers, sizes, rays, offsets):
    lists = [part.tolist() for part in (logits, centers, sizes)]
    return by_hand.ray_loss(
        *lists, MARGIN, [part.tolist() for part in rays], SAMPLES, offsets.tolist()
    )


# float32: places are rounded to 1e-7 of a frame of 6 cells, logits have slopes up to 4 a cell.
@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_the_ray_loss_is_its_loop(torch_rng, dtype, rtol):
    logits, centers, sizes, rays, offsets = random_case(torch_rng, dtype=dtype)
    loss, log = ray_loss(logits, centers, sizes, MARGIN, rays, SAMPLES, offsets)
    wanted, accuracy = loss_by_hand(logits, centers, sizes, rays, offsets)
    assert loss.dtype == dtype and loss.item() == pytest.approx(wanted, rel=rtol)
    assert log["ray_accuracy"].item() == pytest.approx(accuracy, rel=1e-6)
    assert 0.2 < accuracy < 0.8  # both kinds are among them


def test_gradients_of_grids_centres_and_sizes_are_right(torch_rng):
    """The places between cells' centres are those where the loss has a slope at all."""
    logits, centers, sizes, rays, offsets = random_case(torch_rng, objects=3, count=6)
    leaves = [part.requires_grad_() for part in (logits, centers, sizes)]

    def loss(*leaves):
        return ray_loss(*leaves, MARGIN, rays, SAMPLES, offsets)[0]

    assert torch.autograd.gradcheck(loss, leaves, eps=1e-7, atol=1e-6)
    for slope in torch.autograd.grad(loss(*leaves), leaves):
        assert slope.flatten(1).any(dim=1).all()


def one_ray(origin, direction, until=math.inf, hit=True):
    direction = F.normalize(torch.tensor([[direction]], dtype=torch.float64), dim=-1)
    return Rays(
        torch.tensor([[origin]], dtype=torch.float64), direction, torch.tensor([[hit]]),
        torch.tensor([[until]], dtype=torch.float64),
    )  # fmt: skip


def part_of(rays, center=(0.0, 0, 0), frame=(2.0, 2, 2), samples=2):
    """Ends of the part of a ray in the frame, x y z in metres about its middle; None: no part."""
    center, frame = (torch.tensor([part], dtype=torch.float64) for part in (center, frame))
    ends = [
        places_in_frame(center, frame, rays, samples, torch.full((1, 1), end, dtype=torch.float64))
        for end in (0.0, 1.0)
    ]
    (first, counted), (last, _) = ends
    return [p.flip(-1)[0, 0, k].tolist() for p, k in ((first, 0), (last, -1))] if counted else None


def test_the_part_of_a_ray_that_is_in_the_frame():
    through = part_of(one_ray([-3.0, 0.5, 0.25], [1.0, 0, 0]))
    assert through == [[-1, 0.5, 0.25], [1, 0.5, 0.25]]
    # A camera inside starts where it stands; behind it the ray is nowhere.
    assert part_of(one_ray([0.5, 0.0, 0], [1.0, 0, 0])) == [[0.5, 0, 0], [1, 0, 0]]
    assert part_of(one_ray([1.5, 0.0, 0], [1.0, 0, 0])) is None
    assert part_of(one_ray([-3.0, 1.5, 0], [1.0, 0, 0])) is None  # beside it
    # In a side or along an edge it still is in the frame; a corner alone has no length.
    assert part_of(one_ray([-3.0, 1.0, 0], [1.0, 0, 0])) == [[-1, 1, 0], [1, 1, 0]]
    assert part_of(one_ray([-3.0, 1.0, 1], [1.0, 0, 0])) == [[-1, 1, 1], [1, 1, 1]]
    assert part_of(one_ray([-2.0, 0.0, 0], [1.0, 1, 0])) is None
    # What is known ends in the frame, or before it.
    assert part_of(one_ray([-3.0, 0.0, 0], [1.0, 0, 0], until=2.5)) == [[-1, 0, 0], [-0.5, 0, 0]]
    assert part_of(one_ray([-3.0, 0.0, 0], [1.0, 0, 0], until=2.0)) is None
    assert part_of(one_ray([0.0, 0.0, 0], [1.0, 0, 0], until=0.0)) is None


@pytest.mark.parametrize("hit", [True, False])
def test_a_ray_through_two_objects_judges_each_by_its_own_grid(hit):
    """The one behind is known only up to the one in front, which leaves it without a part."""
    centers = torch.tensor([[0.0, 0, 0], [3.0, 0, 0]], dtype=torch.float64)
    sizes = torch.ones(2, 3, dtype=torch.float64)
    ray = one_ray([-3.0, 0.0, 0], [1.0, 0, 0], hit=hit)
    both = Rays(*(part.expand(2, *part.shape[1:]) for part in ray))
    logits = torch.full((2, 4, 4, 4), 3.0, dtype=torch.float64, requires_grad=True)
    offsets = torch.full((2, 1), 0.5, dtype=torch.float64)
    loss, log = ray_loss(logits, centers, sizes, 1.0, both, 8, offsets)
    soft = 3 + math.log(8) / 8
    wanted = math.log1p(math.exp(-soft if hit else soft))
    assert loss.item() == pytest.approx(wanted, rel=1e-12) and log["ray_accuracy"] == hit
    behind = both._replace(until_m=torch.tensor([[torch.inf], [5.0]], dtype=torch.float64))
    loss, _ = ray_loss(logits, centers, sizes, 1.0, behind, 8, offsets)
    loss.backward()
    assert loss.item() == pytest.approx(wanted, rel=1e-12)
    assert logits.grad[0].any() and not logits.grad[1].any()


@pytest.mark.parametrize("count", [0, 3])
def test_objects_that_no_ray_tells_of_cost_nothing(torch_rng, count):
    logits, centers, sizes, rays, offsets = random_case(torch_rng, count=max(count, 3))
    rays = rays._replace(until_m=torch.zeros_like(rays.until_m))
    rays = Rays(*(part[:, :count] for part in rays))
    leaves = [part.requires_grad_() for part in (logits, centers, sizes)]
    loss, log = ray_loss(*leaves, MARGIN, rays, SAMPLES, offsets[:, :count])
    assert loss.item() == 0 and log["ray_accuracy"] == 0
    for slope in torch.autograd.grad(loss, leaves):
        assert (slope == 0).all()


def test_one_object_without_rays_leaves_the_others_as_they_are(torch_rng):
    logits, centers, sizes, rays, offsets = random_case(torch_rng)
    until = rays.until_m.clone()
    until[1] = 0
    some = [0, 2, 3]
    with_it, _ = ray_loss(
        logits, centers, sizes, MARGIN, rays._replace(until_m=until), SAMPLES, offsets
    )
    without, _ = ray_loss(
        logits[some], centers[some], sizes[some], MARGIN, Rays(*(part[some] for part in rays)),
        SAMPLES, offsets[some],
    )  # fmt: skip
    assert_close(with_it, without, rtol=1e-12, atol=0)


def test_total_variation_is_its_loop_and_has_its_gradient(torch_rng):
    logits = 3 * torch.randn(6, 3, 4, 5, generator=torch_rng, dtype=torch.float64)
    assert total_variation(logits).item() == pytest.approx(
        by_hand.total_variation(logits.tolist()), rel=1e-12
    )
    assert torch.autograd.gradcheck(total_variation, (logits.requires_grad_(),))
    single = total_variation(logits.detach().float())
    # Sums of 60 numbers to 1.
    assert single.item() == pytest.approx(total_variation(logits.detach()).item(), rel=1e-6)


def test_total_variation_of_what_is_flat_is_nothing():
    logits = torch.ones(5, 4, 4, 4, requires_grad=True)
    total_variation(logits).backward()
    assert total_variation(logits) == 0 and (logits.grad == 0).all()
    half = torch.full((1, 4, 4, 4), -50.0)
    half[:, :, 2:] = 50
    assert total_variation(half).item() == pytest.approx(1 / 3)  # one of three steps along y


def test_a_box_that_stands_beside_its_rays_walks_back(torch_rng):
    """Descent: rays at a cube 20 cm off move the centre of a grid that is a cube."""
    near = 8 * (1 - torch.linspace(-1.9, 1.9, 20).abs())
    grid = torch.minimum(torch.minimum(near[:, None, None], near[:, None]), near)[None]
    start, size = torch.tensor([[0.2, -0.1, 0.1]]), torch.full((1, 3), 2.0)
    center = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([center], lr=0.01)
    for _ in range(150):
        origins = 3 * F.normalize(torch.randn(1, 200, 3, generator=torch_rng), dim=-1)
        aims = 1.2 * (2 * torch.rand(1, 200, 3, generator=torch_rng) - 1)
        directions = F.normalize(aims - origins, dim=-1)
        offsets = torch.rand(1, 200, generator=torch_rng)
        rays = Rays(origins, directions, offsets < 0, torch.full((1, 200), torch.inf))
        # The grid's cube fills half of its frame's 2 m.
        _, hit = places_in_frame(torch.zeros(1, 3), torch.ones(1, 3), rays, 1, offsets)
        loss, _ = ray_loss(grid, center, size, 1.0, rays._replace(is_hit=hit), 24, offsets)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert center.detach().abs().max() < 0.02 < start.abs().max()


def test_a_batch_without_objects_has_no_loss_but_a_gradient():
    """As where no view of a batch's rooms shows anything twice, or a process got a blank draw."""
    logits = torch.zeros(0, 8, 8, 8, requires_grad=True)
    rays = Rays(
        torch.zeros(0, 4, 3), torch.zeros(0, 4, 3), torch.zeros(0, 4, dtype=torch.bool),
        torch.zeros(0, 4),
    )  # fmt: skip
    boxes = torch.zeros(0, 3)
    loss, seen = ray_loss(logits, boxes, boxes, 1.1, rays, 4, torch.zeros(0, 4))
    total = loss + total_variation(logits)
    total.backward()
    assert total == 0 and seen["ray_accuracy"] == 0 and logits.grad.shape == logits.shape

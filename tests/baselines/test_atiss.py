"""ATISS: mixtures of discretised logistics, sets in, distributions out, rooms sampled."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from torch.testing import assert_close

from sceneprior.baselines.atiss import (
    END,
    HALF_STEP,
    LEVELS,
    Atiss,
    AtissModel,
    LogisticMixture,
    part_of_rooms,
)
from sceneprior.baselines.one_stage import TruthDataset
from sceneprior.core.views import RoomBoxes


@pytest.fixture
def mixture(torch_rng) -> LogisticMixture:
    """Seven mixtures of five, from so wide that half lies outside to narrower than a step."""
    features = torch.randn(7, 15, generator=torch_rng, dtype=torch.float64)
    features[:, 10:] = 3 * features[:, 10:] - 3
    return LogisticMixture.of(features)


def test_all_steps_together_are_certain(mixture):
    steps = torch.linspace(-1, 1, LEVELS, dtype=torch.float64)
    every = torch.stack([mixture.log_prob(step.expand(7)) for step in steps]).exp()
    assert_close(every.sum(dim=0), torch.ones(7, dtype=torch.float64), rtol=0, atol=1e-12)


def test_a_step_is_a_difference_of_scipys_distribution_functions(mixture):
    rng = np.random.default_rng(1)
    values = rng.uniform(-0.99, 0.99, size=(200, 7))
    weights = mixture.weight_logits.softmax(dim=-1).numpy()
    distribution = stats.logistic(mixture.means.numpy(), mixture.log_scales.exp().numpy())
    v = values[..., None]
    # From whichever end is smaller, so that scipy's difference keeps its digits.
    below = distribution.cdf(v + HALF_STEP) - distribution.cdf(v - HALF_STEP)
    above = distribution.sf(v - HALF_STEP) - distribution.sf(v + HALF_STEP)
    each = np.where(v < mixture.means.numpy(), below, above)
    wanted = np.log((weights * each).sum(axis=-1))
    ours = torch.stack([mixture.log_prob(row) for row in torch.from_numpy(values)])
    np.testing.assert_allclose(ours.numpy(), wanted, rtol=1e-9)


def test_gradients(mixture):
    values = torch.tensor([-1.0, -0.7, -0.1, 0.0, 0.3, 0.8, 1.0], dtype=torch.float64)
    parts = [
        part.clone().requires_grad_(True)
        for part in (mixture.weight_logits, mixture.means, mixture.log_scales.clamp(min=-4))
    ]
    assert torch.autograd.gradcheck(lambda *p: LogisticMixture(*p).log_prob(values), parts)


def test_draws_follow_the_distribution(torch_rng):
    """Kolmogorov and Smirnov see no difference in 20,000 draws; they see a shift of 0.03."""
    logits = torch.tensor([0.3, -0.5, 1.0])
    means, log_scales = torch.tensor([-0.3, 0.1, 0.4]), torch.tensor([-2.5, -3.5, -3.0])
    many = LogisticMixture(*(part.expand(20_000, -1) for part in (logits, means, log_scales)))
    draws = many.draw(
        torch.rand(20_000, generator=torch_rng), torch.rand(20_000, generator=torch_rng)
    ).numpy()

    def cdf(x):
        distribution = stats.logistic(means.numpy(), log_scales.exp().numpy())
        return (logits.softmax(dim=0).numpy() * distribution.cdf(x[..., None])).sum(axis=-1)

    assert abs(draws).max() <= 1
    assert stats.kstest(draws, cdf).pvalue > 0.01
    assert stats.kstest(draws + 0.03, cdf).pvalue < 1e-6


@pytest.fixture
def network() -> Atiss:
    torch.manual_seed(0)
    sizes = AtissModel(max_objects=9, width=16, layers=2, heads=2, hidden=24, mixtures=3)
    network = Atiss(sizes, classes=6)
    network.low_m.copy_(torch.tensor([-2.0, 0, -3, 0.1, 0.2, 0.3]))
    network.high_m.copy_(torch.tensor([2.0, 2, 3, 1.1, 2.2, 3.3]))
    return network.double().eval()


@pytest.fixture
def objects(torch_rng):
    """Two rooms, of five objects and of three."""
    object_class = torch.randint(1, 6, (2, 5), generator=torch_rng)
    unit = 2 * torch.rand(2, 5, 7, generator=torch_rng, dtype=torch.float64) - 1
    is_object = torch.arange(5) < torch.tensor([[5], [3]])
    return object_class, unit, is_object


def test_the_order_of_the_placed_objects_means_nothing(network, objects):
    object_class, unit, is_object = objects
    known = network.context(*objects)
    for seed in range(4):
        generator = torch.Generator().manual_seed(seed)
        order = torch.randperm(5, generator=generator)
        shuffled = network.context(object_class[:, order], unit[:, order], is_object[:, order])
        # Nothing but the order in which float64 sums are taken differs.
        assert_close(shuffled, known, rtol=0, atol=1e-12)
    moved = unit.clone()
    moved[0, 2, 0] += 0.01
    assert (network.context(object_class, moved, is_object) - known).abs().max() > 1e-4


def test_padding_and_neighbours_in_the_batch_mean_nothing(network, objects):
    object_class, unit, is_object = objects
    alone = network.context(object_class[1:, :3], unit[1:, :3], is_object[1:, :3])
    assert_close(network.context(*objects)[1:], alone, rtol=0, atol=1e-12)
    nothing = network.context(object_class[:, :0], unit[:, :0], is_object[:, :0])
    assert_close(nothing[0], nothing[1], rtol=0, atol=0)


def test_metres_and_back(network, objects):
    label, unit, is_object = objects
    boxes_m, yaw_rad = network.to_metres(unit)
    rooms = RoomBoxes(label, is_object, boxes_m, yaw_rad=yaw_rad)
    assert_close(network.to_unit(rooms), unit)
    assert (yaw_rad.abs() <= math.pi).all()
    plain = network.float()
    rooms = replace(rooms, boxes_m=boxes_m.float(), yaw_rad=yaw_rad.float())
    plain.fit_statistics(rooms)
    inside = plain.to_unit(rooms)[is_object][:, [0, 1, 2, 4, 5, 6]]
    assert_close(inside.amin(dim=0), -torch.ones(6), rtol=0, atol=1e-6)
    assert_close(inside.amax(dim=0), torch.ones(6), rtol=0, atol=1e-6)


def test_angles_that_look_alike_are_near_each_other(network):
    """A hair's breadth to either side of a quarter turn is no jump in what the network learns."""
    quarters = math.pi / 2 * torch.arange(-2, 3, dtype=torch.float64)
    hair = 1e-7 * torch.tensor([[-1.0], [0], [1]], dtype=torch.float64)
    yaw_rad = torch.remainder(quarters + hair + math.pi, 2 * math.pi) - math.pi
    label = torch.ones(3, 5, dtype=torch.long)
    boxes_m = torch.zeros(3, 5, 6, dtype=torch.float64)
    turn = network.to_unit(RoomBoxes(label, label > 0, boxes_m, yaw_rad=yaw_rad))[..., 3]
    assert (turn.amax(dim=0) - turn.amin(dim=0)).max() < 1e-6
    assert turn[1, 0] == turn[1, 4] and len(turn[1].unique()) == 4


def test_the_first_of_many_rooms_are_those_of_few(network):
    """In float64, where the last bits of another batch size are below 1e-10 on every processor; in
    float32 each object inherits the rounding of those before it."""
    rooms, few = network.sample(40, 3), network.sample(5, 3)
    assert torch.equal(few.object_class, rooms.object_class[:5])
    assert_close(few.boxes_m, rooms.boxes_m[:5], rtol=0, atol=1e-10)


def test_rooms_are_in_every_order_and_cut_anywhere(toy_shards):
    rooms = TruthDataset(toy_shards, "train").everything()
    counts = rooms.is_object.sum(dim=1)
    seen, orders = set(), set()
    for seed in range(80):
        part, coming = part_of_rooms(rooms, seed)
        kept = part.is_object.sum(dim=1)
        ended = kept == counts
        assert torch.equal(coming.is_object[:, 0], ~ended)
        assert (coming.object_class[ended] == END).all() and not part.object_class[
            ~part.is_object
        ].any()
        assert (kept <= counts).all()
        for row in range(len(counts)):
            there = part.is_object[row]
            whole = {tuple(b) for b in rooms.boxes_m[row, rooms.is_object[row]].tolist()}
            known = {tuple(b) for b in part.boxes_m[row, there].tolist()}
            assert len(known) == int(kept[row]) and known <= whole
            if not ended[row]:
                box = tuple(coming.boxes_m[row, 0].tolist())
                assert box in whole - known
                at = [tuple(b) for b in rooms.boxes_m[row].tolist()].index(box)
                assert coming.object_class[row, 0] == rooms.object_class[row, at]
                assert coming.yaw_rad[row, 0] == rooms.yaw_rad[row, at]
        seen.add(int(kept[0]))
        orders.add(tuple(part.object_class[0].tolist()))
    assert seen == set(range(int(counts[0]) + 1)) and len(orders) > 10

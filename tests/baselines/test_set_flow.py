"""The set flow: sets in, velocities out, rooms sampled, and a training that fits a few rooms."""

import math
from itertools import permutations

import pytest
import torch
from torch.testing import assert_close

from sceneprior.baselines.set_flow import NUMBERS, SetFlow, SetFlowModel, matched
from sceneprior.core.views import RoomBoxes

CLASSES = 6


@pytest.fixture
def network() -> SetFlow:
    torch.manual_seed(0)
    sizes = SetFlowModel(max_objects=9, width=16, layers=2, heads=2, hidden=24, steps=5)
    network = SetFlow(sizes, CLASSES)
    network.counts.copy_(torch.tensor([0.0, 0, 3, 1, 0, 2, 0, 0, 0, 1]))
    return network.double().eval()


@pytest.fixture
def batch(torch_rng):
    """Tokens of two rooms, of five objects and of three, and a time for each."""
    shape = 2, 5, NUMBERS + CLASSES - 1
    tokens = torch.randn(shape, generator=torch_rng, dtype=torch.float64)
    is_object = torch.arange(5) < torch.tensor([[5], [3]])
    return tokens, torch.tensor([0.2, 0.7], dtype=torch.float64), is_object


@pytest.fixture
def rooms(torch_rng) -> RoomBoxes:
    """Two rooms, of five objects and of three."""
    is_object = torch.arange(5) < torch.tensor([[5], [3]])
    return RoomBoxes(
        object_class=torch.randint(1, CLASSES, (2, 5), generator=torch_rng) * is_object,
        is_object=is_object,
        boxes_m=(torch.rand(2, 5, 6, generator=torch_rng) + 0.1) * is_object[..., None],
        yaw_rad=(2 * torch.rand(2, 5, generator=torch_rng) - 1) * math.pi,
    )


def test_velocities_follow_the_order_of_the_objects(network, batch):
    tokens, time, is_object = batch
    known = network.velocity(*batch)
    for seed in range(4):
        order = torch.randperm(5, generator=torch.Generator().manual_seed(seed))
        shuffled = network.velocity(tokens[:, order], time, is_object[:, order])
        # Nothing but the order in which float64 sums are taken differs.
        assert_close(shuffled, known[:, order], rtol=0, atol=1e-12)
    moved = tokens.clone()
    moved[0, 2, 0] += 0.01
    assert (network.velocity(moved, time, is_object) - known)[0, 4].abs().max() > 1e-6


def test_padding_and_neighbours_in_the_batch_mean_nothing(network, batch):
    tokens, time, is_object = batch
    numbers, logits = network.predict(*batch)
    alone = network.predict(tokens[1:, :3], time[1:], is_object[1:, :3])
    assert_close((numbers[1:, :3], logits[1:, :3]), alone, rtol=0, atol=1e-12)
    assert not numbers[1, 3:].any() and not logits[1, 3:].any()
    empty = torch.tensor([[False] * 5, [True] * 5])
    beside, _ = network.predict(tokens, time, empty)
    assert not beside[0].any() and beside[1].isfinite().all()


def test_tokens_become_the_rooms_again(network, rooms):
    network = network.float()
    network.fit_statistics(rooms)
    tokens = network.to_tokens(rooms)
    known = tokens[rooms.is_object][:, :NUMBERS]
    assert_close(known.mean(dim=0), torch.zeros(NUMBERS), rtol=0, atol=1e-5)
    assert_close(known.std(dim=0, correction=0), torch.ones(NUMBERS), rtol=0, atol=1e-5)
    again = network.to_rooms(tokens, rooms.is_object)
    assert torch.equal(again.object_class, rooms.object_class)
    here = rooms.is_object
    assert_close(again.boxes_m[here], rooms.boxes_m[here])
    assert_close(again.yaw_rad[here], rooms.yaw_rad[here])
    assert network.counts.tolist() == [0, 0, 0, 1, 0, 1, 0, 0, 0, 0]


def test_the_first_of_many_rooms_are_those_of_few(network):
    """In float64, where the last bits of another batch size are below 1e-10 on every processor."""
    rooms, few = network.sample(40, 3), network.sample(5, 3)
    assert torch.equal(few.object_class, rooms.object_class[:5])
    assert_close(few.boxes_m, rooms.boxes_m[:5], rtol=0, atol=1e-10)
    assert_close(few.yaw_rad, rooms.yaw_rad[:5], rtol=0, atol=1e-10)
    assert not torch.equal(network.sample(5, 4).boxes_m, few.boxes_m)


def test_a_flow_that_knows_the_room_ends_in_it(network, rooms, monkeypatch):
    """Whatever the noise: its velocity is the way left over the time left."""
    network = network.float()
    network.fit_statistics(rooms)
    room = network.to_tokens(rooms)
    logits = 100.0 * room[..., NUMBERS:]

    def predict(tokens, time, is_object):
        return ((room - tokens) / (1 - time)[:, None, None])[..., :NUMBERS], logits

    monkeypatch.setattr(network, "predict", predict)
    found = network._integrate(torch.randn(room.shape), rooms.is_object)
    assert_close(found[rooms.is_object], room[rooms.is_object], rtol=0, atol=1e-5)


def test_an_untrained_network_gives_the_best_linear_guess(network, batch):
    """For numbers of mean 0 and spread 1 the posterior mean of (room - noise) at time t is
    (2t - 1) / (t^2 + (1 - t)^2) times the token."""
    tokens, time, is_object = batch
    for value in network.out[-1].parameters():
        torch.nn.init.zeros_(value)
    t = time[:, None, None]
    wanted = tokens[..., :NUMBERS] * (2 * t - 1) / (t**2 + (1 - t) ** 2) * is_object[..., None]
    assert_close(network.predict(*batch)[0], wanted, rtol=0, atol=1e-12)


def test_noise_goes_the_shortest_way_to_the_objects(torch_rng):
    noise = torch.randn(3, 4, 5, generator=torch_rng)
    tokens = torch.randn(3, 4, 5, generator=torch_rng)
    counts = [4, 2, 0]
    is_object = torch.arange(4) < torch.tensor(counts)[:, None]
    found = matched(noise, tokens, is_object)
    for room, count in enumerate(counts):
        ways = {
            order: float(((noise[room, list(order)] - tokens[room, :count]) ** 2).sum())
            for order in permutations(range(count))
        }
        best = min(ways, key=ways.get)
        assert torch.equal(found[room, :count], noise[room, list(best)])

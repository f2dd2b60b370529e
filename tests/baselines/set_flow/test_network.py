"""The set flow: sets in, velocities out, rooms sampled, and a training that fits a few rooms."""

import math
from itertools import permutations

import pytest
import torch
from tiny_runs import tiny_baseline
from torch.testing import assert_close

from sceneprior.baselines.set_flow import NUMBERS, SetFlow, SetFlowModel, matched
from sceneprior.baselines.true_boxes import TruthDataset
from sceneprior.core.views import RoomBoxes
from sceneprior.training.steps import with_cosine

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


def test_a_batch_of_empty_rooms_teaches_nothing(toy_shards):
    stage = tiny_baseline(toy_shards, "set_flow").make()
    dataset = TruthDataset(toy_shards, "train")
    rooms = dataset.__getitems__([(0, -1), (1, -1)])
    tokens = stage.prior.to_tokens(rooms)
    numbers, logits = stage.prior.predict(tokens, torch.zeros(2), rooms.is_object)
    (numbers.sum() + logits.sum()).backward()
    assert all(value.grad is None or not value.grad.any() for value in stage.prior.parameters())


def test_the_first_of_many_rooms_are_those_of_few(network):
    """In float64, where the last bits of another batch size are below 1e-10 on every processor."""
    rooms, few = network.sample(40, 3), network.sample(5, 3)
    assert torch.equal(few.object_class, rooms.object_class[:5])
    assert_close(few.boxes_m, rooms.boxes_m[:5], rtol=0, atol=1e-10)
    assert_close(few.yaw_rad, rooms.yaw_rad[:5], rtol=0, atol=1e-10)
    assert not torch.equal(network.sample(5, 4).boxes_m, few.boxes_m)


def test_rooms_have_as_many_objects_as_training_rooms(network):
    rooms = network.float().sample(400, 0)
    counts = rooms.is_object.sum(dim=1)
    assert torch.equal(rooms.is_object, torch.arange(9) < counts[:, None])
    share = torch.bincount(counts, minlength=10) / 400
    assert_close(share, network.counts / network.counts.sum(), rtol=0, atol=0.08)
    assert set(counts.tolist()) == {2, 3, 5, 9}
    assert (rooms.object_class > 0).equal(rooms.is_object)
    assert (rooms.boxes_m[rooms.is_object][:, 3:] > 0).all()


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


def test_a_set_flow_learns_rooms_by_heart(toy_shards):
    """After training on three rooms, most drawn rooms hold exactly the furniture of one of them."""
    model = {"max_objects": 6, "width": 64, "hidden": 128, "heads": 4, "layers": 2, "dropout": 0.0}
    config = tiny_baseline(toy_shards, "set_flow", model=model | {"steps": 20})
    dataset = TruthDataset(toy_shards, "train")
    stage = config.build(dataset, None)
    rooms = dataset.__getitems__([(row, 0) for row in [0, 1, 2] * 32])
    stage.prior.fit_statistics(rooms)
    built = with_cosine(torch.optim.Adam(stage.prior.parameters(), lr=3e-3), 400)
    optimizer, schedule = built["optimizer"], built["lr_scheduler"]["scheduler"]
    losses = []
    stage.total = lambda losses, weights, batch: sum(losses.values())
    for step in range(400):
        optimizer.zero_grad()
        loss = stage.training_step(rooms, step)
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
    assert sum(losses[-20:]) < 0.5 * sum(losses[:20])
    found = stage.prior.eval().sample(60, 0)
    known = dataset.__getitems__([(row, 0) for row in range(3)])
    holds = [sorted(labels[labels > 0].tolist()) for labels in known.object_class]
    drawn = [sorted(labels[labels > 0].tolist()) for labels in found.object_class]
    assert sum(room in holds for room in drawn) > 30


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

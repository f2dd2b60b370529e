"""The ATISS network: sets in, distributions out, rooms sampled."""

import pytest
import torch
from torch.testing import assert_close

from sceneprior.batches import RoomBoxes
from sceneprior.models.atiss import END, OCTAVES, Atiss, waves


@pytest.fixture
def network() -> Atiss:
    torch.manual_seed(0)
    network = Atiss(6, 9, width=16, layers=2, heads=2, hidden=24, mixtures=3, dropout=0.1)
    network.low_m.copy_(torch.tensor([-2.0, 0, -3, 0.1, 0.2, 0.3]))
    network.high_m.copy_(torch.tensor([2.0, 2, 3, 1.1, 2.2, 3.3]))
    return network.double().eval()


@pytest.fixture
def objects(torch_rng):
    """Two rooms, of five objects and of three."""
    object_class = torch.randint(1, 6, (2, 5), generator=torch_rng)
    unit = 2 * torch.rand(2, 5, 6, generator=torch_rng, dtype=torch.float64) - 1
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


def test_a_room_can_end_and_then_has_neither_place_nor_size(network, objects):
    context = network.context(*objects)
    box = torch.zeros(2, 6, dtype=torch.float64)
    of_each = torch.stack([
        network.log_prob(context, torch.full((2,), label), box)["class"] for label in range(6)
    ])  # fmt: skip
    assert_close(of_each.exp().sum(dim=0), torch.ones(2, dtype=torch.float64))
    end = network.log_prob(context, torch.full((2,), END), box)
    assert not end["position"].any() and not end["size"].any()
    bed = network.log_prob(context, torch.tensor([2, 2]), box)
    assert (bed["position"] < 0).all() and (bed["size"] < 0).all()


def test_sizes_hear_of_class_and_position_and_positions_of_the_class(network, objects):
    context = network.context(*objects)
    box = torch.zeros(2, 6, dtype=torch.float64)
    known = network.log_prob(context, torch.tensor([2, 2]), box)
    other_class = network.log_prob(context, torch.tensor([3, 3]), box)
    assert (other_class["position"] != known["position"]).all()
    elsewhere = box.clone()
    elsewhere[:, 0] = 0.3
    assert (
        network.log_prob(context, torch.tensor([2, 2]), elsewhere)["size"] != known["size"]
    ).all()
    larger = box.clone()
    larger[:, 3] = 0.3
    again = network.log_prob(context, torch.tensor([2, 2]), larger)
    assert torch.equal(again["position"], known["position"])


def test_metres_and_back(network, objects):
    _, unit, is_object = objects
    assert_close(network.to_unit(network.to_metres(unit)), unit)
    rooms = RoomBoxes(objects[0], is_object, network.to_metres(unit).float())
    plain = network.float()
    plain.fit_bounds(rooms)
    inside = plain.to_unit(rooms.boxes_m)[is_object]
    assert_close(inside.amin(dim=0), -torch.ones(6), rtol=0, atol=1e-6)
    assert_close(inside.amax(dim=0), torch.ones(6), rtol=0, atol=1e-6)


def test_rooms_are_sampled_by_their_seed(network):
    network = network.float()
    rooms = network.sample(40, 3)
    again = network.sample(40, 3)
    assert torch.equal(rooms.boxes_m, again.boxes_m)
    assert torch.equal(rooms.object_class, again.object_class)
    assert not torch.equal(rooms.is_object, network.sample(40, 4).is_object)
    # The first of many are those of few, but for the last bits of another batch size.
    few = network.sample(5, 3)
    assert torch.equal(few.object_class, rooms.object_class[:5])
    assert_close(few.boxes_m, rooms.boxes_m[:5], rtol=0, atol=1e-5)


def test_a_sampled_room_ends_once(network):
    rooms = network.float().sample(200, 0)
    counts = rooms.is_object.sum(dim=1)
    assert len(counts.unique()) > 3 and counts.max() <= 9
    assert torch.equal(rooms.is_object, torch.arange(9) < counts[:, None])
    assert (rooms.object_class[rooms.is_object] != END).all()
    assert not rooms.object_class[~rooms.is_object].any()
    boxes_m = rooms.boxes_m[rooms.is_object]
    assert (boxes_m >= network.low_m - 1e-5).all() and (boxes_m <= network.high_m + 1e-5).all()


def test_the_first_class_comes_as_often_as_the_network_says(network):
    network = network.float()
    nothing = torch.zeros(1, 0, 6), torch.zeros(1, 0, dtype=torch.bool)
    context = network.context(torch.zeros(1, 0, dtype=torch.long), *nothing)
    wanted = network.class_head(context).softmax(dim=-1)[0]
    first = network.sample(4000, 0).object_class[:, 0]
    share = torch.bincount(first, minlength=6) / 4000
    # Four standard deviations of a share of 4,000.
    assert (share - wanted).abs().max() < 4 * (0.25 / 4000) ** 0.5


def test_waves_are_octaves():
    x = torch.tensor([[0.25, -0.5]], dtype=torch.float64)
    found = waves(x)
    assert found.shape == (1, 4 * OCTAVES)
    by_hand = [torch.sin(torch.pi * 2**k * v) for v in x[0] for k in range(OCTAVES)]
    by_hand += [torch.cos(torch.pi * 2**k * v) for v in x[0] for k in range(OCTAVES)]
    assert_close(found[0], torch.stack(by_hand), rtol=0, atol=1e-12)

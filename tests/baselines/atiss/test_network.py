"""The ATISS network: sets in, distributions out, rooms sampled."""

import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from sceneprior.baselines.atiss import (
    END,
    OCTAVES,
    PARTS,
    Atiss,
    AtissModel,
    fourier_features,
)
from sceneprior.core.views import RoomBoxes


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


def test_a_room_can_end_and_then_has_no_numbers(network, objects):
    context = network.context(*objects)
    unit = torch.zeros(2, 7, dtype=torch.float64)
    of_each = torch.stack([
        network.log_prob(context, torch.full((2,), label), unit)["class"] for label in range(6)
    ])  # fmt: skip
    assert_close(of_each.exp().sum(dim=0), torch.ones(2, dtype=torch.float64))
    end = network.log_prob(context, torch.full((2,), END), unit)
    bed = network.log_prob(context, torch.tensor([2, 2]), unit)
    for name in PARTS:
        assert not end[name].any() and (bed[name] < 0).all()


def test_each_part_hears_of_the_class_and_of_the_parts_before_it(network, objects):
    context, beds = network.context(*objects), torch.tensor([2, 2])
    unit = torch.zeros(2, 7, dtype=torch.float64)
    known = network.log_prob(context, beds, unit)
    other_class = network.log_prob(context, torch.tensor([3, 3]), unit)
    assert all((other_class[name] != known[name]).all() for name in PARTS)
    for number, hears in ((0, ("angle", "size")), (3, ("size",)), (4, ())):
        moved = unit.clone()
        moved[:, number] = 0.3
        told = network.log_prob(context, beds, moved)
        own = next(name for name, (start, end) in PARTS.items() if start <= number < end)
        for name in PARTS:
            assert (told[name] != known[name]).all() == (name in (*hears, own))


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


def test_a_sampled_room_ends_once(network):
    rooms = network.float().sample(200, 0)
    counts = rooms.is_object.sum(dim=1)
    assert len(counts.unique()) > 3 and counts.max() <= 9
    assert torch.equal(rooms.is_object, torch.arange(9) < counts[:, None])
    assert (rooms.object_class[rooms.is_object] != END).all()
    assert not rooms.object_class[~rooms.is_object].any()
    boxes_m = rooms.boxes_m[rooms.is_object]
    assert (boxes_m >= network.low_m - 1e-5).all() and (boxes_m <= network.high_m + 1e-5).all()


def test_fourier_features_are_octaves():
    x = torch.tensor([[0.25, -0.5]], dtype=torch.float64)
    found = fourier_features(x)
    assert found.shape == (1, 4 * OCTAVES)
    by_hand = [torch.sin(torch.pi * 2**k * v) for v in x[0] for k in range(OCTAVES)]
    by_hand += [torch.cos(torch.pi * 2**k * v) for v in x[0] for k in range(OCTAVES)]
    assert_close(found[0], torch.stack(by_hand), rtol=0, atol=1e-12)

"""ATISS, the set flow and the Sync2Gen-style VAE: sets of true boxes in, rooms of boxes out."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch.testing import assert_close

from sceneprior.baselines.atiss import (
    HALF_STEP,
    Atiss,
    AtissModel,
    LogisticMixture,
)
from sceneprior.baselines.set_flow import NUMBERS, SetFlow, SetFlowModel
from sceneprior.baselines.sync2gen import (
    ANYWHERE,
    AREA_M2,
    BANDWIDTH_M,
    COMPONENTS,
    PairPrior,
    Sync2Gen,
    Sync2genModel,
)
from sceneprior.core.views import RoomBoxes

CLASSES = 6


@pytest.fixture
def rooms(torch_rng) -> RoomBoxes:
    """Two rooms, of five objects and of three; the first has three of class 2."""
    is_object = torch.arange(5) < torch.tensor([[5], [3]])
    return RoomBoxes(
        object_class=torch.tensor([[2, 1, 2, 2, 4], [3, 1, 5, 0, 0]]),
        is_object=is_object,
        boxes_m=(torch.rand(2, 5, 6, generator=torch_rng) + 0.1) * is_object[..., None],
        yaw_rad=(2 * torch.rand(2, 5, generator=torch_rng) - 1) * math.pi,
    )


@pytest.fixture
def atiss() -> Atiss:
    torch.manual_seed(0)
    sizes = AtissModel(max_objects=9, width=16, layers=2, heads=2, hidden=24, mixtures=3)
    return Atiss(sizes, CLASSES).double().eval()


@pytest.fixture
def flow() -> SetFlow:
    torch.manual_seed(0)
    sizes = SetFlowModel(max_objects=9, width=16, layers=2, heads=2, hidden=24, steps=5)
    network = SetFlow(sizes, CLASSES)
    network.counts.copy_(torch.tensor([0.0, 0, 3, 1, 0, 2, 0, 0, 0, 1]))
    return network.double().eval()


@pytest.mark.parametrize("name", ["atiss", "flow"])
def test_the_first_of_many_rooms_are_those_of_few(request, name):
    """In float64, where the last bits of another batch size are below 1e-10 on every processor; in
    float32 each object inherits the rounding of those before it."""
    network = request.getfixturevalue(name)
    rooms, few = network.sample(40, 3), network.sample(5, 3)
    assert torch.equal(few.object_class, rooms.object_class[:5])
    assert_close(few.boxes_m, rooms.boxes_m[:5], rtol=0, atol=1e-10)
    assert_close(few.yaw_rad, rooms.yaw_rad[:5], rtol=0, atol=1e-10)
    assert not torch.equal(network.sample(5, 4).boxes_m, few.boxes_m)


# -- ATISS -----------------------------------------------------------------------------------------


@pytest.fixture
def mixture(torch_rng) -> LogisticMixture:
    """Seven mixtures of five, from so wide that half lies outside to narrower than a step."""
    features = torch.randn(7, 15, generator=torch_rng, dtype=torch.float64)
    features[:, 10:] = 3 * features[:, 10:] - 3
    return LogisticMixture.of(features)


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


def test_the_context_knows_no_order_no_padding_and_no_neighbour(atiss, rooms):
    label, is_object, unit = rooms.object_class, rooms.is_object, atiss.to_unit(rooms).double()
    known = atiss.context(label, unit, is_object)
    for seed in range(4):
        order = torch.randperm(5, generator=torch.Generator().manual_seed(seed))
        shuffled = atiss.context(label[:, order], unit[:, order], is_object[:, order])
        # Nothing but the order in which float64 sums are taken differs.
        assert_close(shuffled, known, rtol=0, atol=1e-12)
    moved = unit.clone()
    moved[0, 2, 0] += 0.01
    assert (atiss.context(label, moved, is_object) - known).abs().max() > 1e-4
    alone = atiss.context(label[1:, :3], unit[1:, :3], is_object[1:, :3])
    assert_close(known[1:], alone, rtol=0, atol=1e-12)
    nothing = atiss.context(label[:, :0], unit[:, :0], is_object[:, :0])
    assert_close(nothing[0], nothing[1], rtol=0, atol=0)


def test_metres_and_back(atiss, rooms):
    plain = atiss.float()
    plain.fit_statistics(rooms)
    unit = plain.to_unit(rooms)
    boxes_m, yaw_rad = plain.to_metres(unit)
    assert_close(boxes_m[rooms.is_object], rooms.boxes_m[rooms.is_object])
    assert_close(yaw_rad, rooms.yaw_rad, rtol=0, atol=1e-5)
    inside = unit[rooms.is_object][:, [0, 1, 2, 4, 5, 6]]
    assert_close(inside.amin(dim=0), -torch.ones(6), rtol=0, atol=1e-6)
    assert_close(inside.amax(dim=0), torch.ones(6), rtol=0, atol=1e-6)


# -- Set flow --------------------------------------------------------------------------------------


@pytest.fixture
def batch(torch_rng):
    """Tokens of two rooms, of five objects and of three, and a time for each."""
    shape = 2, 5, NUMBERS + CLASSES - 1
    tokens = torch.randn(shape, generator=torch_rng, dtype=torch.float64)
    is_object = torch.arange(5) < torch.tensor([[5], [3]])
    return tokens, torch.tensor([0.2, 0.7], dtype=torch.float64), is_object


def test_velocities_follow_the_order_of_the_objects(flow, batch):
    tokens, time, is_object = batch
    known = flow.velocity(*batch)
    for seed in range(4):
        order = torch.randperm(5, generator=torch.Generator().manual_seed(seed))
        shuffled = flow.velocity(tokens[:, order], time, is_object[:, order])
        # Nothing but the order in which float64 sums are taken differs.
        assert_close(shuffled, known[:, order], rtol=0, atol=1e-12)
    moved = tokens.clone()
    moved[0, 2, 0] += 0.01
    assert (flow.velocity(moved, time, is_object) - known)[0, 4].abs().max() > 1e-6


def test_dropout_is_of_the_settings_and_of_training_alone(flow, batch):
    known = flow.predict(*batch)
    for block in flow.blocks:
        assert block.drop.p == 0.1
    assert_close(flow.predict(*batch), known, rtol=0, atol=0)
    flow.train()
    assert not torch.equal(flow.predict(*batch)[0], known[0])


def test_padding_and_neighbours_in_the_batch_mean_nothing(flow, batch):
    tokens, time, is_object = batch
    numbers, logits = flow.predict(*batch)
    alone = flow.predict(tokens[1:, :3], time[1:], is_object[1:, :3])
    assert_close((numbers[1:, :3], logits[1:, :3]), alone, rtol=0, atol=1e-12)
    assert not numbers[1, 3:].any() and not logits[1, 3:].any()
    empty = torch.tensor([[False] * 5, [True] * 5])
    beside, _ = flow.predict(tokens, time, empty)
    assert not beside[0].any() and beside[1].isfinite().all()


def test_tokens_become_the_rooms_again(flow, rooms):
    flow = flow.float()
    flow.fit_statistics(rooms)
    tokens = flow.to_tokens(rooms)
    known = tokens[rooms.is_object][:, :NUMBERS]
    assert_close(known.mean(dim=0), torch.zeros(NUMBERS), rtol=0, atol=1e-5)
    assert_close(known.std(dim=0, correction=0), torch.ones(NUMBERS), rtol=0, atol=1e-5)
    again = flow.to_rooms(tokens, rooms.is_object)
    assert torch.equal(again.object_class, rooms.object_class)
    here = rooms.is_object
    assert_close(again.boxes_m[here], rooms.boxes_m[here])
    assert_close(again.yaw_rad[here], rooms.yaw_rad[here])
    assert flow.counts.tolist() == [0, 0, 0, 1, 0, 1, 0, 0, 0, 0]


def test_a_flow_that_knows_the_room_ends_in_it(flow, rooms, monkeypatch):
    """Whatever the noise: its velocity is the way left over the time left."""
    flow = flow.float()
    flow.fit_statistics(rooms)
    room = flow.to_tokens(rooms)
    logits = 100.0 * room[..., NUMBERS:]

    def predict(tokens, time, is_object):
        return ((room - tokens) / (1 - time)[:, None, None])[..., :NUMBERS], logits

    monkeypatch.setattr(flow, "predict", predict)
    found = flow._integrate(torch.randn(room.shape), rooms.is_object)
    assert_close(found[rooms.is_object], room[rooms.is_object], rtol=0, atol=1e-5)


# -- Sync2Gen --------------------------------------------------------------------------------------


@pytest.fixture
def vae(rooms) -> Sync2Gen:
    torch.manual_seed(0)
    network = Sync2Gen(Sync2genModel(slots=2, width=16, refine_steps=0), CLASSES, seed=0)
    network.fit_statistics(rooms)
    return network


def test_a_matrix_knows_no_order_and_becomes_the_room_again(vae, rooms):
    matrix = vae.to_matrix(rooms)
    for seed in range(4):
        order = torch.randperm(5, generator=torch.Generator().manual_seed(seed))
        assert torch.equal(vae.to_matrix(rooms.take(order.expand(2, -1))), matrix)
    # Of three objects of class 2, one is too many; slots are taken from left to right.
    assert matrix[..., 0].tolist() == [
        [[1, 0], [1, 1], [0, 0], [1, 0], [0, 0]],
        [[1, 0], [0, 0], [1, 0], [0, 0], [1, 0]],
    ]
    twins = rooms.boxes_m[0, [0, 2, 3]]
    found_m = vae.mean_m + vae.spread_m * matrix[..., 1:]
    assert_close(found_m[0, 1], twins[twins[:, 0].argsort()][:2])
    assert not matrix[matrix[..., 0] == 0].any()
    again = vae.to_rooms(torch.cat([matrix[..., :1] * 2 - 1, matrix[..., 1:]], dim=-1))
    assert again.object_class.tolist() == [[1, 2, 2, 4], [1, 3, 5, 0]]
    assert_close(vae.to_matrix(again), matrix)


BED, STAND, LAMP = 1, 2, 3


def room(*objects: tuple[int, float, float], pad: int = 0) -> RoomBoxes:
    """A room of objects (class, x, z); boxes are half a metre high and wide."""
    boxes_m = [[x, 0.25, z, 0.5, 0.5, 0.5] for _, x, z in objects] + [[9.0] * 6] * pad
    return RoomBoxes(
        torch.tensor([[label for label, _, _ in objects] + [0] * pad]),
        torch.tensor([[True] * len(objects) + [False] * pad]),
        torch.tensor([boxes_m]),
    )


@pytest.fixture
def prior() -> PairPrior:
    """Nightstands stand 1.2 m right of beds, or left; lamps were never seen with a bed."""
    prior = PairPrior(4)
    rooms = [room((BED, 0.3 * k, 0), (STAND, 0.3 * k + side, 0.1)) for k in range(4) for side in (
        -1.2, 1.2)]  # fmt: skip
    rooms.append(room((STAND, 0, 0), (LAMP, 1, 1)))
    prior.fit(
        RoomBoxes(*(torch.cat(part) for part in zip(
            *((r.object_class, r.is_object, r.boxes_m) for r in rooms), strict=True))), 0
    )  # fmt: skip
    return prior


def by_hand(prior: PairPrior, rooms: RoomBoxes, start_m: torch.Tensor) -> float:
    energy = 0.0
    count = int(rooms.is_object.sum())
    at = rooms.boxes_m[0][:, [0, 2]].tolist()
    labels = rooms.object_class[0].tolist()
    for i in range(count):
        moved = math.dist(at[i], start_m[0, i].tolist())
        energy += moved**2 / (2 * float(prior.error_m2[labels[i]]))
        terms = []
        for j in range(count):
            if i == j or not prior.known[labels[i], labels[j]]:
                continue
            offset = [at[j][0] - at[i][0], at[j][1] - at[i][1]]
            density = 0.0
            for centre in prior.offsets_m[labels[i], labels[j]].tolist():
                squared = math.dist(offset, centre) ** 2
                density += math.exp(-squared / (2 * BANDWIDTH_M**2))
            density /= COMPONENTS * 2 * math.pi * BANDWIDTH_M**2
            terms.append(math.log((1 - ANYWHERE) * density + ANYWHERE / AREA_M2))
        if terms:
            energy -= sum(terms) / len(terms)
    return energy


def test_the_energy_is_the_loop_over_pairs(prior):
    rooms = room((BED, 0, 0), (STAND, 1.1, 0.2), (LAMP, 1.9, 1), (STAND, -1, 0), pad=2)
    start_m = rooms.boxes_m[..., [0, 2]] + 0.1
    wanted = by_hand(prior, rooms, start_m)
    assert float(prior.energy(rooms, start_m)) == pytest.approx(wanted, rel=1e-5)

"""The Sync2Gen-style VAE: rooms as matrices and back, its losses; the energy of offsets."""

import math

import pytest
import torch
from torch.testing import assert_close

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


@pytest.fixture
def rooms(torch_rng) -> RoomBoxes:
    """Two rooms of classes 1 to 4: in the first three objects of class 2, one too many."""
    return RoomBoxes(
        object_class=torch.tensor([[2, 1, 2, 2, 4], [3, 1, 0, 0, 0]]),
        is_object=torch.tensor([[True] * 5, [True, True, False, False, False]]),
        boxes_m=torch.rand(2, 5, 6, generator=torch_rng) + 0.1,
    )


@pytest.fixture
def network(rooms) -> Sync2Gen:
    torch.manual_seed(0)
    network = Sync2Gen(Sync2genModel(slots=2, width=16, refine_steps=0), classes=5, seed=0)
    network.fit_statistics(rooms)
    return network


def test_a_matrix_knows_no_order(network, rooms):
    known = network.to_matrix(rooms)
    for seed in range(4):
        order = torch.randperm(5, generator=torch.Generator().manual_seed(seed))
        shuffled = RoomBoxes(
            rooms.object_class[:, order], rooms.is_object[:, order], rooms.boxes_m[:, order]
        )
        assert torch.equal(network.to_matrix(shuffled), known)


def test_slots_are_taken_from_left_to_right(network, rooms):
    matrix = network.to_matrix(rooms)
    assert matrix[..., 0].tolist() == [
        [[1, 0], [1, 1], [0, 0], [1, 0]],
        [[1, 0], [0, 0], [1, 0], [0, 0]],
    ]
    found_m = network.mean_m + network.spread_m * matrix[..., 1:]
    twins = rooms.boxes_m[0, [0, 2, 3]]
    leftmost = twins[twins[:, 0].argsort()][:2]
    assert_close(found_m[0, 1], leftmost)
    assert_close(found_m[1, 2, 0], rooms.boxes_m[1, 0])
    assert not matrix[matrix[..., 0] == 0].any()


def test_a_matrix_becomes_the_room_again(network, rooms):
    matrix = network.to_matrix(rooms)
    decoded = torch.cat([matrix[..., :1] * 2 - 1, matrix[..., 1:]], dim=-1)
    again = network.to_rooms(decoded)
    assert again.is_object.sum(dim=1).tolist() == [4, 2]
    assert again.object_class.tolist() == [[1, 2, 2, 4], [1, 3, 0, 0]]
    assert_close(network.to_matrix(again), matrix)


def test_terms_by_hand(network, rooms, torch_rng):
    matrix = network.to_matrix(rooms)
    decoded = torch.randn(matrix.shape, generator=torch_rng)
    mean = torch.randn(2, 20, generator=torch_rng)
    log_variance = torch.randn(2, 20, generator=torch_rng)
    found = network.losses(matrix, decoded, mean, log_variance)
    for room in range(2):
        terms = {"existence": 0.0, "position": 0.0, "size": 0.0}
        for label in range(4):
            for slot in range(2):
                true, said = matrix[room, label, slot], decoded[room, label, slot]
                chance = torch.sigmoid(said[0])
                terms["existence"] -= float(torch.log(chance if true[0] else 1 - chance))
                for k in range(1, 7):
                    off = abs(float(said[k] - true[k]))
                    term = 0.5 * off**2 if off < 1 else off - 0.5
                    terms["position" if k < 4 else "size"] += term * float(true[0])
        for name, value in terms.items():
            assert float(found[name][room]) == pytest.approx(value, rel=1e-5), name
        distribution = torch.distributions.Normal(mean[room], (0.5 * log_variance[room]).exp())
        kl = torch.distributions.kl_divergence(
            distribution, torch.distributions.Normal(0.0, 1.0)
        ).sum()
        assert float(found["kl"][room]) == pytest.approx(float(kl), rel=1e-5)


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


def test_a_nightstand_goes_back_beside_its_bed(prior):
    rooms = room((BED, 0, 0), (STAND, 0.9, 0.35), pad=1)
    refined = prior.refine(rooms, 200)
    offset = refined.boxes_m[0, 1] - refined.boxes_m[0, 0]
    was = rooms.boxes_m[0, 1] - rooms.boxes_m[0, 0]
    aim = torch.tensor([1.2, 0.1])
    assert (offset[[0, 2]] - aim).norm() < 0.3 * (was[[0, 2]] - aim).norm()
    # Heights, sizes and padding stay.
    assert torch.equal(refined.boxes_m[..., [1, 3, 4, 5]], rooms.boxes_m[..., [1, 3, 4, 5]])
    assert torch.equal(refined.boxes_m[0, 2], rooms.boxes_m[0, 2])
    start_m = rooms.boxes_m[..., [0, 2]]
    assert float(prior.energy(refined, start_m)) < float(prior.energy(rooms, start_m))

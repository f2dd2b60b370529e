"""The arrangement VAE: rooms as matrices and back, its terms, its sparse layers, its samples."""

import pytest
import torch
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.baselines.sync2gen import READS, SparseLinear, Sync2Gen, Sync2genModel
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


def test_an_output_of_a_sparse_layer_hears_few_groups(torch_rng):
    layer = SparseLinear(35, 11, group=7, seed=2)
    x = torch.randn(35, generator=torch_rng, requires_grad=True)
    heard = torch.stack([torch.autograd.grad(y, x, retain_graph=True)[0] for y in layer(x)])
    groups = (heard != 0).unflatten(1, (5, 7))
    assert (groups.all(dim=-1) == groups.any(dim=-1)).all()
    assert (groups.any(dim=-1).sum(dim=-1) == READS).all()
    assert len(groups.any(dim=-1).unique(dim=0)) > 1
    assert_close(layer(x), F.linear(x, layer.weight * layer.mask, layer.bias))
    assert torch.equal(layer.mask, SparseLinear(35, 11, group=7, seed=2).mask)
    assert not torch.equal(layer.mask, SparseLinear(35, 11, group=7, seed=3).mask)


def test_errors_of_centres_are_remembered_in_square_metres(network, rooms):
    matrix = network.to_matrix(rooms)
    decoded = matrix.clone()
    decoded[0, 1, 0, 1] += 0.3 / network.spread_m[1, 0, 0]  # 0.3 m along x
    decoded[0, 1, 1, 3] -= 0.1 / network.spread_m[1, 0, 2]  # 0.1 m along z
    decoded[0, 1, :, 2] += 5  # height does not count
    before = network.pairs.error_m2.clone()
    network.note_errors(matrix, decoded)
    after = network.pairs.error_m2
    newest = (0.3**2 / 2 + 0.1**2 / 2) / 2
    assert float(after[2]) == pytest.approx(0.95 * float(before[2]) + 0.05 * newest, rel=1e-4)
    assert float(after[1]) == pytest.approx(0.95 * float(before[1]), rel=1e-4)
    assert torch.equal(after[0], before[0])

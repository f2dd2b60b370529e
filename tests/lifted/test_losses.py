"""Lifted boxes as targets: the matching against all permutations, the terms against loops; and the
distance of training latents to drawn ones."""

import warnings
from itertools import permutations

import pytest
import torch
from scipy.optimize import linear_sum_assignment
from tiny_runs import tiny_lifted
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.core.errors import InputWarning
from sceneprior.core.views import DecodedScenes
from sceneprior.lifted.lifting.dataset import LiftedRooms
from sceneprior.lifted.prototype_decoder import PosedScenes
from sceneprior.lifted.stages import (
    PER_METRE,
    latent_loss,
    lifted_losses,
    match_lifted,
    shape_code_loss,
    sliced_wasserstein,
)

COUNTS = (3, 2, 0)


@pytest.fixture
def rooms(torch_rng) -> LiftedRooms:
    is_object = torch.arange(3) < torch.tensor(COUNTS)[:, None]
    return LiftedRooms(
        room_index=torch.arange(3),
        object_class=torch.randint(1, 4, (3, 3), generator=torch_rng) * is_object,
        is_object=is_object,
        is_lifted=is_object & torch.tensor([[True, True, False], [True, True, True], [True] * 3]),
        boxes_m=torch.rand(3, 3, 6, generator=torch_rng, dtype=torch.float64) * 3,
        looks=torch.full((3, 3), -1),
    )


@pytest.fixture
def scenes(torch_rng) -> DecodedScenes:
    def random(*shape):
        return torch.randn(*shape, generator=torch_rng, dtype=torch.float64)

    return DecodedScenes(random(3, 5, 4), random(3, 5, 3), random(3, 5, 3).exp(), random(3, 5))


def cost(scenes, rooms, room, prediction, item, weight):
    if not rooms.is_lifted[room, item]:
        return 0.0
    box = torch.cat([scenes.centers_m[room, prediction], scenes.sizes_m[room, prediction]])
    chance = scenes.class_logits[room, prediction].softmax(-1)[rooms.object_class[room, item]]
    return float(weight * PER_METRE * (box - rooms.boxes_m[room, item]).abs().sum() - chance)


@pytest.mark.parametrize("weight", [0.0, 1.0, 5.0])
def test_the_match_is_the_cheapest_of_all_permutations_of_the_first_n(scenes, rooms, weight):
    matches = match_lifted(scenes, rooms, weight)
    assert torch.equal(matches.valid, rooms.is_lifted)
    for room, count in enumerate(COUNTS):
        chosen = matches.prediction[room, :count].tolist()
        totals = {
            order: sum(
                cost(scenes, rooms, room, prediction, item, weight)
                for item, prediction in enumerate(order)
            )
            for order in permutations(range(count))
        }
        assert totals[tuple(chosen)] == pytest.approx(min(totals.values()), abs=1e-12)


def test_the_terms_are_their_definitions(scenes, rooms):
    matches = match_lifted(scenes, rooms)
    losses = lifted_losses(scenes, rooms, matches, "first_n")
    boxes, classes = [], []
    for room, item in rooms.is_lifted.nonzero().tolist():
        k = int(matches.prediction[room, item])
        box = torch.cat([scenes.centers_m[room, k], scenes.sizes_m[room, k]])
        boxes.append(PER_METRE * (box - rooms.boxes_m[room, item]).abs().sum())
        classes.append(
            -scenes.class_logits[room, k].log_softmax(-1)[rooms.object_class[room, item]]
        )
    wanted = torch.arange(5) < torch.tensor(COUNTS)[:, None]
    # The third room has no objects: it stands for none.
    entropy = F.binary_cross_entropy_with_logits(
        scenes.completeness_logits, wanted.double(), reduction="none"
    )
    score = torch.cat([entropy[0, : COUNTS[0] + 1], entropy[1, : COUNTS[1] + 1]]).mean()
    assert_close(losses["box"], torch.stack(boxes).mean(), rtol=0, atol=1e-12)
    assert_close(losses["class"], torch.stack(classes).mean(), rtol=0, atol=1e-12)
    assert_close(losses["completeness"], score, rtol=0, atol=1e-12)
    assert set(losses) == {"box", "class", "completeness"}


def test_rooms_without_objects_have_no_loss_and_no_nan(scenes, rooms):
    none = rooms.changed(torch.zeros_like)
    losses = lifted_losses(scenes, none, match_lifted(scenes, none), "first_n")
    assert losses["box"] == 0 and losses["class"] == 0 and losses["completeness"] == 0


def test_the_distance_of_codes_is_a_filled_cell_s(scenes, rooms, torch_rng):
    """Object by object; float64 gradients."""
    cells = torch.tensor([[1.0, 4, 2], [5, 3, 1], [1, 1, 1]], dtype=torch.float64)
    codes = torch.randn(3, 5, 2, generator=torch_rng, dtype=torch.float64, requires_grad=True)
    wanted = torch.randn(3, 3, 2, generator=torch_rng).double()
    matches = match_lifted(scenes, rooms)
    apart = []
    for room, item in rooms.is_lifted.nonzero().tolist():
        k = int(matches.prediction[room, item])
        apart.append((codes[room, k] - wanted[room, item]).square().sum() / cells[room, item])

    def loss(codes):
        return shape_code_loss(PosedScenes.of(scenes, shape_codes=codes), matches, wanted, cells)

    assert_close(loss(codes), torch.stack(apart).mean(), rtol=0, atol=1e-12)
    assert torch.autograd.gradcheck(loss, codes)


def points(rows, columns, seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(rows, columns, generator=generator, dtype=torch.float64)


def test_the_distance_on_each_line_is_that_of_the_cheapest_assignment():
    some, others = points(9, 4, 0) * 2, points(9, 4, 1) + 1
    directions = F.normalize(points(4, 5, 2), dim=0)
    cheapest = []
    for line in directions.T:
        cost = (some @ line)[:, None].sub((others @ line)[None]).square().numpy()
        cheapest.append(cost[linear_sum_assignment(cost)].mean())
    expected = torch.tensor(cheapest).mean()
    assert_close(sliced_wasserstein(some, others, directions), expected.double())


def test_gradients_are_right():
    some, others, directions = points(6, 3, 0), points(6, 3, 1), points(3, 4, 2)
    assert torch.autograd.gradcheck(
        lambda x: sliced_wasserstein(x, others, directions), some.requires_grad_()
    )


def test_what_the_sphere_does_not_see_counts_for_nothing():
    logits, shift = points(20, 7, 0), points(20, 1, 1)

    def loss(of, shift_free):
        return latent_loss(of, shift_free, torch.Generator().manual_seed(3))

    assert_close(loss(logits + shift, True), loss(logits, True))
    assert loss(logits + shift, False) > 1.5 * loss(logits, False)


def test_few_training_rooms_are_warned_of(toy_shards, monkeypatch):
    stage = tiny_lifted(toy_shards).stages()[0]
    rooms = stage.open_data()
    count = len(rooms.plain_ids)
    with pytest.warns(InputWarning, match=f"only {count} rooms, so new rooms will be implausible"):
        stage.build(rooms, None)
    monkeypatch.setattr("sceneprior.lifted.config.FEW_ROOMS", count)
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        stage.build(rooms, None)

"""Offsets between classes: the energy as it is defined, and rooms that go down it."""

import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from sceneprior.baselines import sync2gen as arrangement
from sceneprior.baselines.sync2gen import (
    ANYWHERE,
    AREA_M2,
    BANDWIDTH_M,
    COMPONENTS,
    PairPrior,
)
from sceneprior.core.views import RoomBoxes

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


def test_offsets_are_those_of_the_training_rooms(prior):
    assert prior.known.nonzero().tolist() == [
        [BED, STAND],
        [STAND, BED],
        [STAND, LAMP],
        [LAMP, STAND],
    ]
    found = {tuple(offset) for offset in prior.offsets_m[BED, STAND].mul(10).round().int().tolist()}
    assert found == {(-12, 1), (12, 1)}
    assert prior.offsets_m[STAND, BED].mul(10).round().int()[:, 1].unique().tolist() == [-1]


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


def test_strangers_and_lone_objects_stay_where_they_are(prior):
    for rooms in (room((BED, 0.3, 0)), room((BED, 0, 0), (LAMP, 0.1, 0.1))):
        assert torch.equal(prior.refine(rooms, 20).boxes_m, rooms.boxes_m)
    rooms = room((BED, 0, 0), (STAND, 0.9, 0.35))
    assert torch.equal(prior.refine(rooms, 0).boxes_m, rooms.boxes_m)  # no step, no move
    assert not torch.equal(prior.refine(rooms, 1).boxes_m, rooms.boxes_m)


def test_rooms_do_not_depend_on_their_neighbours(prior, monkeypatch):
    one, other = room((BED, 0, 0), (STAND, 0.9, 0.3)), room((BED, 0, 1), (STAND, -1, 0.7))
    both = RoomBoxes(*(torch.cat(part) for part in zip(
        *((r.object_class, r.is_object, r.boxes_m) for r in (one, other)), strict=True
    )))  # fmt: skip
    known = prior.refine(both, 30).boxes_m
    assert_close(prior.refine(other, 30).boxes_m, known[1:], rtol=0, atol=1e-5)
    monkeypatch.setattr(arrangement, "BATCH", 1)
    assert_close(prior.refine(replace(both), 30).boxes_m, known, rtol=0, atol=1e-5)

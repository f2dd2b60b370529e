"""The sampler's network: order does not matter, and likelihoods are those of a plain loop."""

import copy
from dataclasses import replace

import pytest
import torch
from rooms_of_boxes import sampler_rooms, small_sampler
from torch.testing import assert_close

from sceneprior.core.boxes import QUARTERS
from sceneprior.lifted.prototypes import PosedRooms, turn_posed
from sceneprior.lifted.sampler.contents import END
from sceneprior.lifted.sampler.frames import SYMMETRIES, rectangles_of
from sceneprior.lifted.sampler.rooms import SamplerRooms, frames_of, large_first, shuffled
from sceneprior.lifted.sampler.stage import negative_log_likelihood


@pytest.fixture(scope="module")
def rooms() -> SamplerRooms:
    return sampler_rooms()


@pytest.fixture(scope="module")
def sampler(rooms):
    return small_sampler(rooms).double()


def in_float64(rooms: PosedRooms) -> PosedRooms:
    return rooms.changed(lambda part: part.double() if part.is_floating_point() else part)


def as_they_are(rooms: PosedRooms) -> torch.Tensor:
    return torch.zeros(len(rooms.boxes_m), dtype=torch.int64)


def read(sampler, rooms: PosedRooms, rectangle_m: torch.Tensor, coming=None, symmetry=None):
    if coming is None:
        coming = torch.zeros(len(rooms.boxes_m), len(sampler.may_meet)).double()
    if symmetry is None:
        symmetry = as_they_are(rooms)
    return sampler.read(rooms, coming, rectangle_m, symmetry, sampler.tokens(rooms, rectangle_m))


def test_order_and_padding_change_nothing(sampler, rooms):
    whole = in_float64(rooms.rooms)
    frame = rectangles_of(whole)
    plain = read(sampler, whole, frame)
    order = torch.tensor([[2, 0, 1]]).expand(len(frame), -1)
    mixed = read(sampler, whole.take(order), frame)
    assert_close(mixed.context, plain.context)
    wrong = whole.boxes_m.where(whole.is_object.unsqueeze(-1), 99.0)
    filled = PosedRooms(whole.object_class, whole.is_object, wrong, looks=whole.looks)
    assert torch.equal(read(sampler, filled, frame).context, plain.context)


@torch.no_grad()
def test_likelihoods_are_those_of_one_object_after_the_other(sampler, rooms):
    whole = in_float64(rooms.rooms)
    symmetry = torch.arange(len(whole.boxes_m))
    fast = negative_log_likelihood(sampler, whole, symmetry, torch.Generator().manual_seed(4))
    generator = torch.Generator().manual_seed(4)
    listed = shuffled(whole, generator)
    uniform = torch.rand(whole.is_object.shape, generator=generator).double()
    offers = sampler.offers()
    mixed = whole.take(large_first(whole, sampler.footprints_m2, uniform))
    frames = frames_of(mixed, generator)
    mixed = replace(mixed, walls_m=None)  # walls are no slots, which are cut below
    classes = len(sampler.may_meet)
    for row in range(len(whole.boxes_m)):
        one = mixed.changed(lambda part, row=row: part[row : row + 1])
        frame, count = frames[row : row + 1], int(one.is_object.sum())
        slow = dict.fromkeys(fast, 0.0)
        for step in range(count + 1):
            labels = [*listed.object_class[row, :count].tolist(), END]
            counts = torch.tensor(labels[:step], dtype=torch.int64).bincount(minlength=classes)
            logits = sampler.contents(counts[None].double(), frame[:, 2:]).log_softmax(dim=-1)
            slow["class"] -= float(logits[0, labels[step]])
        for step in range(count):
            rest = one.object_class[0, step:count]
            before = one.changed(lambda part, step=step: part[:, :step])
            following = one.changed(lambda part, step=step: part[:, step : step + 1])
            coming = rest.bincount(minlength=classes)[None].double()
            reading = read(sampler, before, frame, coming, symmetry[row : row + 1])
            for name, value in sampler.log_prob(reading, following, offers).items():
                slow[name] -= float(value)
        for name, value in slow.items():
            assert value == pytest.approx(float(fast[name][row]), rel=1e-9), name


def test_how_often_a_look_comes_turns_with_the_room(sampler, rooms):
    """A look that is likely in a room as it is, is as likely turned where the room is turned."""
    whole = in_float64(rooms.rooms).changed(lambda part: part[:1])
    frame = rectangles_of(whole)
    plain = read(sampler, whole, frame)
    label = torch.tensor([1])
    before = sampler.look_logits(plain, label, sampler.offers())
    with torch.no_grad():
        sampler.frequency[0, 2] += 3.0
    try:
        for number in range(SYMMETRIES):
            shown = torch.tensor([number])
            reading = plain._replace(symmetry=shown)
            gain = sampler.look_logits(reading, label, sampler.offers()) - before
            at = turn_posed(torch.tensor([[2]]), shown % QUARTERS, shown >= QUARTERS)
            likelier = (gain > 1.5) & before.isfinite()
            assert likelier.nonzero()[:, 1].tolist() == at[0].tolist()
    finally:
        with torch.no_grad():
            sampler.frequency[0, 2] -= 3.0


def test_gradients_of_the_likelihood_are_right(rooms):
    sampler = small_sampler(rooms, width=8).double().requires_grad_(True)
    two = in_float64(rooms.rooms).changed(lambda part: part[:2])

    def loss(query: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        changed = {"query": query, "placement.along_z.pair_table": weight}
        parts = torch.func.functional_call(
            _Likelihood(sampler), {f"sampler.{k}": v for k, v in changed.items()}, (two,)
        )
        return torch.stack(list(parts.values())).sum()

    start = (sampler.query, sampler.placement.along_z.pair_table)
    leaves = [value.detach().clone().requires_grad_(True) for value in start]
    assert torch.autograd.gradcheck(loss, leaves, fast_mode=True)


class _Likelihood(torch.nn.Module):
    def __init__(self, sampler):
        super().__init__()
        self.sampler = copy.deepcopy(sampler)

    def forward(self, rooms: PosedRooms) -> dict[str, torch.Tensor]:
        generator = torch.Generator().manual_seed(0)
        return negative_log_likelihood(self.sampler, rooms, as_they_are(rooms), generator)

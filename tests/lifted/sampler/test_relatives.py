"""Scores of looks relative to those of earlier objects: they turn with the room, and are sums over
its objects."""

import math

import pytest
import torch
from torch.testing import assert_close

from sceneprior.core.geometry.turns import QUARTERS
from sceneprior.core.views import RoomBoxes
from sceneprior.lifted.prototypes import POSES, turned_looks
from sceneprior.lifted.sampler.frames import side_of
from sceneprior.lifted.sampler.relatives import MOST_LOG, Relatives
from sceneprior.lifted.sampler.rooms import SYMMETRIES, turned_rooms

CLASSES, PROTOTYPES = 4, 3
LOOKS = PROTOTYPES * POSES
BACKS = torch.tensor([0, 1, 3])


@pytest.fixture
def relatives() -> Relatives:
    """With random tables."""
    torch.manual_seed(0)
    relatives = Relatives(CLASSES).double()
    with torch.no_grad():
        for table in relatives.parameters():
            table.normal_()
    return relatives


@pytest.fixture
def rooms() -> RoomBoxes:
    """Four rooms with four objects each; the last one has two."""
    rng = torch.Generator().manual_seed(2)
    boxes_m = 0.2 + torch.rand(4, 4, 6, generator=rng).double()
    boxes_m[0, 0, 3:] = torch.tensor([9.0, 1.0, 0.1])  # longer than `MOST_LOG`
    is_object = torch.ones(4, 4, dtype=torch.bool)
    is_object[-1, 2:] = False
    classes = torch.randint(1, CLASSES, (4, 4), generator=rng)
    return RoomBoxes(
        classes * is_object, is_object, boxes_m,
        looks=torch.randint(LOOKS, (4, 4), generator=rng),
    )  # fmt: skip


LABEL = torch.tensor([1, 2, 3, 1])


@torch.no_grad()
def test_scores_are_those_of_a_plain_loop(relatives, rooms):
    found = relatives(LABEL, rooms, BACKS, LOOKS)
    assert rooms.looks is not None
    for row, label in enumerate(LABEL.tolist()):
        for look in range(LOOKS):
            side, total = int(side_of(torch.tensor(look), BACKS)), 0.0
            repeats = False
            for item in rooms.is_object[row].nonzero()[:, 0].tolist():
                other, known = int(rooms.object_class[row, item]), rooms.looks[row, item]
                table = relatives.direction_table[label, other].tolist()
                turn = (int(side_of(known, BACKS)) - side) % QUARTERS
                total += table[{0: 0, 1: 2, 2: 1, 3: 2}[turn]]
                x, z = rooms.boxes_m[row, item, [3, 5]].tolist()
                ratio = math.log(z / x) if side in (0, 2) else math.log(x / z)
                ratio = max(-MOST_LOG, min(MOST_LOG, ratio))
                total += table[3] * ratio + table[4] * abs(ratio)
                repeats |= other == label and int(known) // POSES == look // POSES
            total += float(relatives.repeat_table[label]) * repeats
            assert float(found[row, look]) == pytest.approx(total, abs=1e-12)


@torch.no_grad()
@pytest.mark.parametrize("symmetry", range(SYMMETRIES))
def test_scores_turn_with_the_room(relatives, rooms, symmetry):
    """A look has the score that the turned look has in the turned room, mirrored ones too."""
    plain = relatives(LABEL, rooms, BACKS, LOOKS)
    by = torch.full((4,), symmetry)
    found = relatives(LABEL, turned_rooms(rooms, by), BACKS, LOOKS)
    looks = torch.arange(LOOKS).expand(4, -1)
    at = turned_looks(looks, by % QUARTERS, by >= QUARTERS)
    assert_close(found.gather(1, at), plain, rtol=0, atol=1e-12)


@torch.no_grad()
def test_order_and_padding_change_nothing(relatives, rooms):
    plain = relatives(LABEL, rooms, BACKS, LOOKS)
    order = torch.tensor([[3, 1, 0, 2], [2, 3, 1, 0], [1, 0, 3, 2], [1, 0, 2, 3]])
    assert_close(relatives(LABEL, rooms.take(order), BACKS, LOOKS), plain)
    boxes_m = rooms.boxes_m.where(rooms.is_object.unsqueeze(-1), 0.0)
    padded = RoomBoxes(rooms.object_class, rooms.is_object, boxes_m, looks=rooms.looks)
    assert_close(relatives(LABEL, padded, BACKS, LOOKS), plain)


@torch.no_grad()
def test_empty_rooms_prefer_no_look(relatives, rooms):
    nothing = rooms.changed(lambda part: part[:, :0])
    assert not relatives(LABEL, nothing, BACKS, LOOKS).any()

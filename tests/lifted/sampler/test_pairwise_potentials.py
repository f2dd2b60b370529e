"""Scores of looks by a room's other furniture: they turn with the room, and are those of a loop."""

import math

import pytest
import torch
from torch.testing import assert_close

from sceneprior.core.boxes import QUARTERS
from sceneprior.lifted.prototypes import POSES, PosedRooms, turn_posed
from sceneprior.lifted.sampler.contents import MANY, MOST_LOG, PairwisePotentials
from sceneprior.lifted.sampler.frames import SYMMETRIES, side_of, turned_rooms

CLASSES, PROTOTYPES = 4, 3
LOOKS = PROTOTYPES * POSES
BACKS = torch.tensor([0, 1, 3])


@pytest.fixture
def scores() -> PairwisePotentials:
    """With random tables."""
    torch.manual_seed(0)
    scores = PairwisePotentials(CLASSES).double()
    with torch.no_grad():
        for table in scores.parameters():
            table.normal_()
    return scores


@pytest.fixture
def rooms() -> PosedRooms:
    """Four rooms with four objects each; the last one has two."""
    rng = torch.Generator().manual_seed(2)
    boxes_m = 0.2 + torch.rand(4, 4, 6, generator=rng).double()
    boxes_m[0, 0, 3:] = torch.tensor([9.0, 1.0, 0.1])  # longer than `MOST_LOG`
    is_object = torch.ones(4, 4, dtype=torch.bool)
    is_object[-1, 2:] = False
    classes = torch.randint(1, CLASSES, (4, 4), generator=rng)
    return PosedRooms(
        classes * is_object, is_object, boxes_m,
        looks=torch.randint(LOOKS, (4, 4), generator=rng),
    )  # fmt: skip


LABEL = torch.tensor([1, 2, 3, 1])
COUNTS = torch.tensor([[0, 1, 2, 4], [0, 0, 1, 3], [0, 0, 0, 1], [0, 1, 0, 0]]).double()
COUNTS = torch.cat([COUNTS, (COUNTS - 1).clamp(min=0)], dim=1)  # then those placed


def look_shown() -> torch.Tensor:
    """Encodings of three prototypes in eight poses; odd poses exchange the extents x and z."""
    logs = torch.randn(PROTOTYPES, 3, generator=torch.Generator().manual_seed(3)).double()
    poses = [logs.flip(-1) if pose % 2 else logs for pose in range(POSES)]
    return torch.nn.functional.pad(torch.stack(poses, dim=1).flatten(0, 1), (4, 0))


def scored(scores: PairwisePotentials, rooms: PosedRooms) -> torch.Tensor:
    return scores(LABEL, rooms, COUNTS, look_shown(), BACKS)


@torch.no_grad()
def test_scores_are_those_of_a_plain_loop(scores, rooms):
    found = scored(scores, rooms)
    assert rooms.looks is not None
    for row, label in enumerate(LABEL.tolist()):
        for look in range(LOOKS):
            side, total = int(side_of(torch.tensor(look), BACKS)), 0.0
            repeats, facing = False, [0, 0, 0]
            for item in rooms.is_object[row].nonzero()[:, 0].tolist():
                other, known = int(rooms.object_class[row, item]), rooms.looks[row, item]
                table = scores.direction_table[label, other].tolist()
                turn = (int(side_of(known, BACKS)) - side) % QUARTERS
                relation = {0: 0, 1: 2, 2: 1, 3: 2}[turn]
                total += table[relation]
                facing[relation] += other == label
                x, z = rooms.boxes_m[row, item, [3, 5]].tolist()
                ratio = math.log(z / x) if side in (0, 2) else math.log(x / z)
                total += table[3] * max(-MOST_LOG, min(MOST_LOG, ratio))
                repeats |= other == label and int(known) // POSES == look // POSES
            total += float(scores.repeat_table[label]) * repeats
            for relation, number in enumerate(facing):
                reached = scores.facing_table[label, relation, :number, : int(COUNTS[row, label])]
                total += float(reached.sum())
            x, _, z = look_shown()[look, -3:].tolist()
            for other in range(2 * CLASSES):
                for times in range(1, MANY + 1):
                    if COUNTS[row, other] >= times:
                        area, ratio, square = scores.size_table[label, other, times - 1].tolist()
                        total += area * (x + z) + ratio * abs(x - z) + square * (x + z) ** 2
            assert float(found[row, look]) == pytest.approx(total, abs=1e-12)


@torch.no_grad()
@pytest.mark.parametrize("symmetry", range(SYMMETRIES))
def test_scores_turn_with_the_room(scores, rooms, symmetry):
    """A look has the score that the turned look has in the turned room, mirrored ones too."""
    plain = scored(scores, rooms)
    by = torch.full((4,), symmetry)
    found = scored(scores, turned_rooms(rooms, by))
    looks = torch.arange(LOOKS).expand(4, -1)
    at = turn_posed(looks, by % QUARTERS, by >= QUARTERS)
    assert_close(found.gather(1, at), plain, rtol=0, atol=1e-12)

"""Training data of the sampler: sets of lifted objects, turned and mirrored exactly."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from rooms_of_boxes import CLASSES, lifted_rooms, sampler_rooms, small_sampler
from torch.testing import assert_close

from sceneprior.core.boxes import turn_boxes
from sceneprior.core.wall_lines import Wall
from sceneprior.lifted.lifting.dataset import LiftedDataset
from sceneprior.lifted.prototypes import PosedRooms
from sceneprior.lifted.sampler.frames import (
    SYMMETRIES,
    rectangle_sides,
    rectangles_of,
    turned_rooms,
)
from sceneprior.lifted.sampler.rooms import LOOSELY, SamplerRooms, frames_of, large_first


@pytest.fixture(scope="module")
def rooms() -> SamplerRooms:
    return sampler_rooms()


def with_looks(lifted: LiftedDataset) -> SamplerRooms:
    return SamplerRooms(lifted).assign_prototypes(lifted_rooms().find_prototypes(99))


def test_objects_without_a_label_or_a_box_are_left_out():
    lifted = lifted_rooms()
    lifted.object_classes[0] = 0
    lifted.its_boxes[1].explained[2] = 0
    lifted.its_boxes[1].sizes_m[2] = 0
    found = with_looks(lifted).rooms
    assert found.is_object.sum(dim=1).tolist()[:2] == [1, 2]
    assert found.object_class[0, 0] == 2


def wall(start, end, inward, error_m=0.01):
    return Wall(np.array(start), np.array(end), np.array(inward, dtype=float), error_m)


def test_rectangles_end_at_walls_near_the_furniture():
    lifted = lifted_rooms()
    middle, extents = rectangles_of(sampler_rooms().rooms)[0].double().numpy().reshape(2, 2)
    (x1, z1), (x2, z2) = middle - extents / 2, middle + extents / 2
    lifted.walls[0] = [
        wall((x1 - 0.3, z1), (x1 - 0.3, z2), (1, 0)),
        wall((x1 - 0.1, z1), (x1 - 0.1, z2), (1, 0)),  # nearer
        wall((x1 - 0.05, z2 + 0.1), (x1 - 0.05, z2 + 1), (1, 0)),  # beside the furniture
        wall((x1 - 0.02, z1), (x1 - 0.02, z2), (-1, 0)),  # faces away
        wall((x1, z1 + 0.02), (x2, z1 + 0.02), (0, 1)),  # cut by a badly lifted box
        wall((x2 + 0.6, z1), (x2 + 0.6, z2), (-1, 0)),  # far
        wall((x1, z2 + 0.2), (x2, z2 + 0.2), (0, -1), error_m=0.2),  # not sure
    ]
    rooms = with_looks(lifted).rooms
    known = rooms.walls_m[0].isfinite().tolist()
    assert known == [True, True, False, False]  # low z, low x, high z, high x
    assert not rooms.walls_m[1:].isfinite().any()
    for seed in range(3):
        frames = frames_of(rooms, torch.Generator().manual_seed(seed))
        low, high = rectangle_sides(frames[0].double())
        assert_close(low, torch.tensor([x1 - 0.1, z1], dtype=torch.float64), rtol=0, atol=1e-6)
        assert high[0] > x2 and high[1] > z2
        plain = frames_of(replace(rooms, walls_m=None), torch.Generator().manual_seed(seed))
        assert torch.equal(frames[1:], plain[1:])


def test_large_classes_and_large_objects_of_a_class_come_first(torch_rng):
    """As a plain loop orders them: classes by their footprints, then each one's objects."""
    label = torch.tensor([[1, 2, 2, 1, 2, 0], [2, 1, 0, 0, 0, 0], [0] * 6])
    footprints_m2 = torch.tensor([1.0, 0.2, 0.7])
    boxes_m = torch.rand(3, 6, 6) + 0.1
    uniform = torch.rand(3, 6)
    rooms = PosedRooms(label, label > 0, boxes_m * (label > 0)[..., None])
    found = large_first(rooms, footprints_m2, uniform)
    for row in range(3):
        there = [item for item in range(6) if label[row, item]]
        late = (LOOSELY * uniform[row]).tolist()
        x, z = boxes_m[row, :, 3].log().tolist(), boxes_m[row, :, 5].log().tolist()
        means = footprints_m2.log()[label[row]].tolist()
        classes = [int(label[row, k]) for k in sorted(there, key=lambda k: late[k] - means[k])]
        by_size = sorted(there, key=lambda k: late[k] - x[k] - z[k])
        left = {name: [k for k in by_size if label[row, k] == name] for name in (1, 2)}
        assert found[row, : len(there)].tolist() == [left[name].pop(0) for name in classes]
        assert sorted(found[row].tolist()) == list(range(6))
    uniform[:] = 0.5  # nothing comes late
    plain = rooms.take(large_first(rooms, footprints_m2, uniform))
    assert plain.object_class.tolist() == [[2, 2, 2, 1, 1, 0], [2, 1, 0, 0, 0, 0], [0] * 6]


@pytest.mark.parametrize("symmetry", range(SYMMETRIES))
def test_walls_turn_with_their_room(rooms, symmetry):
    walls = torch.tensor([[1.0, 2.0, 3.0, math.nan]]).expand(len(rooms), 4)
    turned = turned_rooms(replace(rooms.rooms, walls_m=walls), torch.full((len(rooms),), symmetry))
    # Outwards of low z, low x, high z and high x; the last wall is unknown.
    outwards = torch.tensor([[[0.0, 0, -1], [-1, 0, 0], [0, 0, 1]]])
    boxes = torch.cat([outwards, torch.ones(1, 3, 3)], dim=-1)
    quarters, mirrored = torch.tensor([symmetry % 4]), torch.tensor([symmetry >= 4])
    for distance, way in zip(
        (1.0, 2.0, 3.0), turn_boxes(boxes, quarters, mirrored)[0], strict=True
    ):
        side = {(0, -1): 0, (-1, 0): 1, (0, 1): 2, (1, 0): 3}[
            round(way[0].item()), round(way[2].item())
        ]
        assert turned.walls_m[0, side] == distance
    assert turned.walls_m.isnan().sum() == len(rooms)


def test_symmetries_move_boxes_looks_and_rectangles_together(rooms):
    batch = rooms.rooms
    seen = set()
    for number in range(SYMMETRIES):
        turned = turned_rooms(batch, torch.full((len(rooms),), number))
        assert torch.equal(turned.object_class, batch.object_class)
        sizes = batch.boxes_m[..., 3:].sort(dim=-1).values
        assert torch.equal(turned.boxes_m[..., 3:].sort(dim=-1).values, sizes)
        # The look's own extents turn with the box's: the L-shaped sofa has no symmetry.
        shown = torch.from_numpy(rooms.prototypes.shown())[turned.looks][..., -3:]
        off = (shown.exp() - turned.boxes_m[..., 3:]).abs() / turned.boxes_m[..., 3:]
        assert off[turned.is_object].max() < 0.1
        same = torch.equal(turned.boxes_m, batch.boxes_m) and torch.equal(turned.looks, batch.looks)
        assert same == (number == 0)
        seen.add(int(turned.looks[0, 0] % 8))
    assert len(seen) == SYMMETRIES


def test_classes_may_meet_that_do_often_enough():
    lifted = lifted_rooms(12)
    for room in (1, 3, 5):  # of six with a third object: its box stands in the second's
        lifted.its_boxes[room].centers_m[2] = lifted.its_boxes[room].centers_m[1]
    found = with_looks(lifted).may_meet(CLASSES)
    assert found.nonzero().tolist() == [[2, 3], [3, 2]]
    lifted.its_boxes[1].centers_m[2] += 5
    lifted.its_boxes[3].centers_m[2] += 5
    assert not with_looks(lifted).may_meet(CLASSES).any()


def test_a_single_room_has_enough_rectangles_for_all_components():
    sampler = small_sampler(sampler_rooms(1))
    drawn_m = sampler.rectangles(torch.rand(50), torch.randn(50, 4))
    assert_close(drawn_m.mean(dim=0), rectangles_of(sampler_rooms(1).rooms)[0], atol=0.4, rtol=0)

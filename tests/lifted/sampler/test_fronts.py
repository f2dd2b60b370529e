import numpy as np
import pytest
import torch

from sceneprior.core.boxes import QUARTERS, turn_boxes
from sceneprior.core.parts import whole_box
from sceneprior.lifted.prototypes import PosedRooms, Prototypes, turn_posed
from sceneprior.lifted.sampler.frames import SYMMETRIES, own_sides, side_of, turned_rooms
from sceneprior.lifted.sampler.prototype_statistics import _gaps_to_furniture, find_sides

CELLS = 8


def prototypes(*grids: np.ndarray) -> Prototypes:
    count = len(grids)
    sizes_m = np.tile([1.0, 1.0, 1.0], (count, 1))
    return Prototypes(
        (whole_box(),) * count, np.stack(grids), sizes_m, np.ones(count, int), np.ones(count, bool)
    )


def chair(back: int) -> np.ndarray:
    """A seat with a backrest at one of the four sides: low z, low x, high z, high x."""
    grid = np.zeros((CELLS,) * 3, dtype=bool)
    grid[:, :4] = True
    rest = (slice(None), slice(4, None), 0), (0, slice(4, None)), (slice(None), slice(4, None), -1)
    grid[(*rest, (-1, slice(4, None)))[back]] = True
    return grid


def room(*boxes_m: list[float], looks: list[int]) -> PosedRooms:
    count = len(boxes_m)
    return PosedRooms(
        torch.ones(1, count, dtype=torch.int64), torch.ones(1, count, dtype=torch.bool),
        torch.tensor([boxes_m]), looks=torch.tensor([looks]),
    )  # fmt: skip


ALONE = [0.0, 0.5, 0.0, 1.0, 1.0, 1.0]
RUG = [0.0, 0.05, 0.0, 6.0, 0.1, 6.0]


@pytest.mark.parametrize("back", range(QUARTERS))
def test_a_chair_in_the_middle_faces_away_from_its_backrest(back):
    alone = room(ALONE, looks=[0])
    fronts, confidence = find_sides(alone, prototypes(chair(back)))[1:]
    assert fronts.tolist() == [(back + 2) % QUARTERS]
    assert 0.25 < confidence[0] < 1


def test_a_box_at_a_wall_faces_the_room_and_one_at_a_table_faces_the_table():
    cube = np.ones((CELLS,) * 3, dtype=bool)
    at_wall = room([-2.5, 0.5, 0.0, 1.0, 1.0, 1.0], RUG, looks=[0, 8])
    backs, fronts, confidence = find_sides(at_wall, prototypes(cube, cube))
    assert backs[0] == 1
    assert fronts[0] == 3 and confidence[0] > 0.9  # low x is the wall
    assert confidence[1] == pytest.approx(0.25)  # all sides of the rug are at walls
    table = room([0.0, 0.5, 2.5, 1.0, 1.0, 1.0], [0.0, 0.5, 1.4, 1.0, 1.0, 1.0], looks=[8, 0])
    gaps_m = _gaps_to_furniture(table)
    assert gaps_m[0, 1].tolist() == [1, 1, pytest.approx(0.1), 1]
    assert gaps_m[0, 0].tolist() == [pytest.approx(0.1), 1, 1, 1]


def test_fronts_turn_with_their_rooms():
    """Every symmetry of the room and of the looks tells the same sides of the prototype."""
    rng = torch.Generator().manual_seed(0)
    boxes_m = torch.rand(6, 5, 6, generator=rng) + torch.tensor([0, 0, 0, 0.5, 0.5, 0.5])
    boxes_m[..., ::2] *= 2
    looks = torch.randint(0, 16, (6, 5), generator=rng)
    here = torch.rand(6, 5, generator=rng) < 0.8
    rooms = PosedRooms(torch.ones(6, 5, dtype=torch.int64), here, boxes_m, looks=looks)
    kinds = prototypes(chair(1), np.ones((CELLS,) * 3, dtype=bool))
    plain = find_sides(rooms, kinds)
    for symmetry in range(SYMMETRIES):
        turned = turned_rooms(rooms, torch.full((6,), symmetry))
        torch.testing.assert_close(find_sides(turned, kinds), plain, rtol=1e-4, atol=1e-5)


def test_sides_follow_a_marker_through_every_pose():
    """A marker at the low-x side of a prototype is found where `own_sides` says, in each pose."""
    marker = torch.tensor([[[-1.0, 0.0, 0.0, 0.1, 0.1, 0.1]]])
    for pose in range(8):
        quarters, mirrored = torch.tensor([pose % 4]), torch.tensor([pose >= 4])
        x, _, z = turn_boxes(marker, quarters, mirrored)[0, 0, :3].tolist()
        side = {(0, -1): 0, (-1, 0): 1, (0, 1): 2, (1, 0): 3}[round(x), round(z)]
        look = turn_posed(torch.tensor([[8]]), quarters, mirrored)[0]
        assert int(look) == 8 + pose
        assert own_sides(look)[0, 1] == side
        assert side_of(look, torch.tensor([0, 1])) == side

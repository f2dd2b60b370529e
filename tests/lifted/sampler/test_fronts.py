from dataclasses import replace

import numpy as np
import pytest
import torch

from sceneprior.core.boxes import QUARTERS, turn_boxes
from sceneprior.core.parts import whole_box
from sceneprior.core.wall_lines import Wall
from sceneprior.lifted.prototypes import POSES, PosedRooms, Prototypes, turn_posed
from sceneprior.lifted.sampler.frames import SYMMETRIES, own_sides, side_of, turned_rooms
from sceneprior.lifted.sampler.orientation import gaps_to_walls, orient, room_cues

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
NAMES = ("void", "armchair", "wardrobe", "desk")
FLOOR = [Wall(3.0 * (way - across), 3.0 * (way + across), -way, 0.0) for way, across in (
    (np.array([0.0, -1.0]), np.array([1.0, 0.0])), (np.array([-1.0, 0.0]), np.array([0.0, 1.0])),
    (np.array([0.0, 1.0]), np.array([1.0, 0.0])), (np.array([1.0, 0.0]), np.array([0.0, 1.0])),
)]  # fmt: skip
"""Walls 3 m from the origin, on all four sides."""


def oriented(rooms: PosedRooms, kinds: Prototypes, errors: torch.Tensor | None = None, backs=None):
    """`orient` with the walls `FLOOR`, of objects whose rays all poses explain equally well."""
    to_walls = [torch.from_numpy(gaps_to_walls(boxes.numpy(), FLOOR)) for boxes in rooms.boxes_m]
    if errors is None:
        errors = torch.zeros(*rooms.is_object.shape, POSES)
    return orient(rooms, torch.stack(to_walls), errors.double(), kinds, NAMES, backs)


@pytest.mark.parametrize("back", range(QUARTERS))
def test_a_chair_in_the_middle_faces_away_from_its_backrest(back):
    """Its rays tell the pose, and its shape the back."""
    errors = torch.full((1, 1, POSES), 0.3)
    errors[..., 0] = 0.0
    found = oriented(room(ALONE, looks=[0]), prototypes(chair(back)), errors)
    assert found.backs.tolist() == [back] and found.looks.tolist() == [[0]]
    assert 0.25 < found.confidence[0] < 1


def test_wardrobes_turn_their_backs_to_their_walls():
    """One shape that looks alike from all sides, at two walls: one back, two poses."""
    cube = np.ones((CELLS,) * 3, dtype=bool)
    at_walls = room([-2.5, 0.5, 0.0, 1.0, 1.0, 1.0], [0.0, 0.5, -2.5, 1.0, 1.0, 1.0], looks=[0, 0])
    at_walls = replace(at_walls, object_class=torch.full((1, 2), 2))
    kinds = prototypes(cube)._replace(object_class=np.array([2]))
    found = oriented(at_walls, kinds)
    assert side_of(found.looks, found.backs).tolist() == [[1, 0]]
    assert found.confidence[0] > 0.6
    # A back known from other rooms is kept, and the poses follow it.
    for back in range(QUARTERS):
        other = oriented(at_walls, kinds, backs=torch.tensor([back]))
        assert other.backs.tolist() == [back]
        assert side_of(other.looks, other.backs).tolist() == [[1, 0]]
    # Rays that only one pose explains outweigh the walls.
    errors = torch.full((1, 2, POSES), 0.5)
    errors[..., 0] = 0.0
    assert oriented(at_walls, kinds, errors).looks.tolist() == [[0, 0]]


def test_a_chair_turns_its_back_away_from_its_desk():
    desk, seat = [0.0, 0.5, -2.5, 1.0, 1.0, 1.0], [0.0, 0.5, -1.4, 1.0, 1.0, 1.0]
    one = replace(room(desk, seat, looks=[8, 0]), object_class=torch.tensor([[3, 4]]))
    to_walls = torch.from_numpy(gaps_to_walls(np.array([desk, seat]), FLOOR))[None]
    cube = np.ones((CELLS,) * 3, dtype=bool)
    kinds = prototypes(cube, cube)._replace(object_class=np.array([4, 3]))
    found = orient(one, to_walls, torch.zeros(1, 2, POSES).double(), kinds, (*NAMES, "chair"))
    assert side_of(found.looks, found.backs)[0, 1] == 2  # the desk is at low z


def test_gaps_of_a_room_by_hand():
    boxes_m = [0.0, 0.5, 2.5, 1.0, 1.0, 1.0], [0.0, 0.5, 1.4, 1.0, 1.0, 1.0]
    plain = room(*boxes_m, looks=[8, 0])
    rooms = replace(plain, object_class=torch.tensor([[3, 1]]))
    to_walls = gaps_to_walls(np.array(boxes_m), FLOOR)
    np.testing.assert_allclose(to_walls, [[5, 2.5, 0, 2.5], [3.9, 2.5, 1.1, 2.5]], atol=1e-6)
    beside = gaps_to_walls(np.array(boxes_m), FLOOR[:2])  # the other sides of the rectangle
    np.testing.assert_allclose(beside, [[5, 2.5, 0, 0], [3.9, 2.5, 1.1, 0]], atol=1e-6)
    cues = room_cues(rooms, torch.from_numpy(to_walls)[None], NAMES)[0]
    walls, furniture, blocked, table, opposite, screens = cues.unbind(dim=-1)
    assert walls.tolist() == [[1, 1, 0, 1], [1, 1, 1, 1]]
    near = pytest.approx(0.1)
    assert furniture.tolist() == [[near, 1, 1, 1], [1, 1, near, 1]]
    assert blocked.tolist() == [[near, 1, 0, 1], [1, 1, near, 1]]
    assert table.tolist() == [[1, 1, 1, 1], [1, 1, near, 1]]
    assert opposite.tolist() == [[1, 1, 1, 1], [near, 1, 1, 1]]
    assert not screens.any()


def test_backs_turn_with_their_rooms():
    """In every symmetry of the rooms, backs are the same, and looks turn with the rooms."""
    rng = torch.Generator().manual_seed(0)
    boxes_m = torch.rand(6, 5, 6, generator=rng) + torch.tensor([0, 0, 0, 0.5, 0.5, 0.5])
    boxes_m[..., ::2] *= 2
    looks = torch.randint(0, 16, (6, 5), generator=rng)
    here = torch.rand(6, 5, generator=rng) < 0.8
    rooms = PosedRooms(torch.ones(6, 5, dtype=torch.int64), here, boxes_m, looks=looks)
    kinds = prototypes(chair(1), chair(0))
    errors = torch.rand(6, 5, POSES, generator=rng).double()
    to_walls = torch.rand(6, 5, QUARTERS, generator=rng).double()
    plain = orient(rooms, to_walls, errors, kinds, NAMES)
    for symmetry in range(SYMMETRIES):
        turned = turned_rooms(rooms, torch.full((6,), symmetry))
        poses = turn_posed(
            torch.arange(POSES)[None], torch.tensor([symmetry % 4]), torch.tensor([symmetry > 3])
        )[0]
        walls = torch.zeros_like(to_walls)
        walls[..., own_sides(torch.tensor(symmetry))] = to_walls
        moved = torch.zeros_like(errors)
        moved[..., poses] = errors
        found = orient(turned, walls, moved, kinds, NAMES)
        assert found.backs.equal(plain.backs)
        torch.testing.assert_close(found.confidence, plain.confidence)
        wanted = turned_rooms(replace(rooms, looks=plain.looks), torch.full((6,), symmetry))
        assert found.looks[here].equal(wanted.looks[here])


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

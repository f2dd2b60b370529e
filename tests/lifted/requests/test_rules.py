"""Placement rules: walls behind backs, and paths, compared with a walk from cell to cell."""

import numpy as np
import pytest

from sceneprior.core.scene import Opening
from sceneprior.lifted.requests.floors import Floor, RoomShape, read_floor
from sceneprior.lifted.requests.relations import Furniture
from sceneprior.lifted.requests.rules import (
    CELL_M,
    PATH_M,
    Paths,
    PlacementRules,
    backed_by_walls,
    needs_access,
)

DOOR = Opening("door", (-0.45, -1.5), (0.45, -1.5), 0.0, 2.0)
SHAPE = RoomShape(Floor(read_floor("4x3")), (DOOR,))


def box(x: float, z: float, width: float, depth: float, bottom: float = 0.0) -> list[float]:
    return [x, bottom + 0.5, z, width, 1.0, depth]


def reached(*boxes: list[float], shape: RoomShape = SHAPE) -> list[bool]:
    found = Paths(shape).reached(np.array(boxes), np.ones(len(boxes), dtype=bool))
    return [bool(each) for each in found]


@pytest.mark.parametrize(("gap_m", "open_"), [(0.5, False), (0.56, False), (0.66, True)])
def test_a_way_is_as_wide_as_it_says(gap_m, open_):
    barrier = box(-gap_m / 2, 0.3, 4 - gap_m, 0.3)
    assert PATH_M == 0.6 and reached(box(-1, 1.2, 1, 0.5), barrier) == [open_, True]


def test_lamps_need_no_way_and_rooms_without_doors_none_at_all():
    desk, barrier = box(0, 1.2, 1, 0.5), box(0, 0.3, 4, 0.3)
    found = Paths(SHAPE).reached(np.array([desk, barrier]), np.array([False, True]))
    assert found.tolist() == [True, True]
    assert reached(desk, barrier, shape=RoomShape(Floor(read_floor("4x3")))) == [True, True]
    assert needs_access(["desk", "floor_lamp", "plant"]).tolist() == [True, False, False]


def test_ways_are_those_of_a_walk_from_cell_to_cell():
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(12):
        boxes = np.array([
            box(*rng.uniform(-1.6, 1.6, 2), *rng.uniform(0.3, 1.6, 2)) for _ in range(5)
        ])  # fmt: skip
        found = Paths(SHAPE).reached(boxes, np.ones(5, dtype=bool)).tolist()
        assert found == walked_to(boxes)
        seen |= set(found)
    assert seen == {True, False}


def walked_to(boxes: np.ndarray) -> list[bool]:
    """A walk over cells whose middle is half a way from walls and boxes, as `Paths` has them."""
    nx, nz = round(4 / CELL_M), round(3 / CELL_M)
    margin = PATH_M / 2 - CELL_M / 2

    def blocked(i: int, j: int, wide: float, row: np.ndarray) -> bool:
        return all(
            round((c - s / 2 - wide - low) / CELL_M) <= k < round((c + s / 2 + wide - low) / CELL_M)
            for k, c, s, low in ((i, row[0], row[3], -2.0), (j, row[2], row[5], -1.5))
        )

    free = set()
    for i in range(nx):
        for j in range(nz):
            x, z = -2 + (i + 0.5) * CELL_M, -1.5 + (j + 0.5) * CELL_M
            inside = abs(x) < 2 - margin - 1e-6 and abs(z) < 1.5 - margin - 1e-6
            if inside and not any(blocked(i, j, margin, row) for row in boxes):
                free.add((i, j))
    door = (int(2 / CELL_M), int((PATH_M / 2 + CELL_M / 2) / CELL_M))
    walk = [cell for cell in free if max(abs(cell[0] - door[0]), abs(cell[1] - door[1])) <= 2]
    walked = set(walk)
    while walk:
        i, j = walk.pop()
        for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if cell in free and cell not in walked:
                walked.add(cell)
                walk.append(cell)
    wide = PATH_M / 2 + 0.1
    return [any(blocked(i, j, wide, row) for i, j in walked) for row in boxes]


def test_backs_at_the_inner_side_of_an_l_are_no_backs_at_walls():
    """A box at z = 3 of the lower arm: where the upper arm goes on, there is no wall."""
    outline = [[0, 0], [5, 0], [5, 3], [2.5, 3], [2.5, 6], [0, 6]]
    shape = RoomShape(Floor(read_floor(outline)))
    arm = np.array([[2.5, 1.5, 5.0, 3.0]] * 3)
    boxes = np.array([[1.0, 0.5, 2.5, 1, 1, 1], [4.0, 0.5, 2.5, 1, 1, 1], [1.0, 0.5, 1.5, 1, 1, 1]])
    at_high_z = Furniture(boxes, np.array([1, 1, 1]), np.array([2, 2, 2]), np.zeros((3, 2)))
    assert backed_by_walls(shape, at_high_z, arm).tolist() == [False, True, True]


@pytest.mark.parametrize("barred", [False, True])
def test_new_objects_leave_the_path_to_a_given_one_if_it_has_one(barred):
    """A given bed at the far side; a given barrier before it may have no path to the bed."""
    bed, barrier = box(0, 1.0, 1, 1), box(0, -0.1, 4, 0.3)
    given = furniture([bed, barrier] if barred else [bed])
    rules = PlacementRules(SHAPE, [], ["bed"], given, True)
    rectangles_m = np.array([[0.0, 0.0, 4.0, 3.0]] * 2)
    places = furniture([box(0, 0.1, 4, 0.2), box(-1.6, -0.9, 0.4, 0.2)])
    allowed, _ = rules.allowed(0, places, given, [], rectangles_m, enough=2)
    assert allowed.tolist() == [False, True]


def furniture(boxes: list[list[float]]) -> Furniture:
    count = len(boxes)
    return Furniture(np.array(boxes), np.zeros(count, int), np.full(count, 1), np.zeros((count, 2)))


@pytest.mark.parametrize(("wardrobe", "front", "closed"), [
    ([1.75, 1.0, -0.2, 0.5, 2.0, 1.6], (-1, 0), set()),
    ([1.1, 1.0, -1.2, 1.8, 2.0, 0.6], (0, 1), {3}),  # bars the way past the bed's foot
])  # fmt: skip
def test_a_wardrobe_leaves_paths_to_its_front_and_to_both_sides_of_a_bed(wardrobe, front, closed):
    """The door is in the wall at the bed's foot; nightstands are rows 2 and 3."""
    classes = ["wardrobe", "double_bed", "nightstand"]
    boxes = [wardrobe, [0, 0.4, 0.49, 1.6, 0.8, 2.0]]
    boxes += [[side * 1.05, 0.25, 1.25, 0.45, 0.5, 0.45] for side in (-1, 1)]
    fronts = np.array([front, (0, -1), (0, -1), (0, -1)], float)
    room = Furniture(np.array(boxes), np.array([0, 1, 2, 2]), np.full(4, -1), fronts)
    door = Opening("door", (-1.9, -1.5), (-1.0, -1.5), 0.0, 2.0)
    shape = RoomShape(Floor(read_floor("4x3")), (door,))
    rules = PlacementRules(shape, [], classes, room.rows([]), True)
    failed = rules.faults(room)
    assert {row for key, (row, *_) in failed if key == "path to the bedside"} == closed
    assert (("path to the front", (0,)) in failed) == bool(closed)
    turned = room._replace(front=np.array([front, (0, -1), (0, -1), (0, 1)], float))
    assert rules.faults(turned) - failed == {("turned as the bed", (3,))}
    low = room._replace(boxes_m=room.boxes_m.copy())
    low.boxes_m[3, [1, 4]] -= 0.05, 0.1
    assert rules.faults(low) - failed == {("as large as the other", (2, 3))}

"""Relations at places where they barely hold and barely fail, and in partly furnished rooms."""

import numpy as np
import pytest

from sceneprior.core.scene import Opening
from sceneprior.lifted.requests.floors import Floor, RoomShape, read_floor
from sceneprior.lifted.requests.relations import (
    OUTWARD,
    Furniture,
    RelationChecks,
    opening_items,
    related,
    related_to_room,
)
from sceneprior.lifted.requests.wishes import RelationWish

FLOOR = [[-4, -4], [4, -4], [4, 4], [0, 4], [0, 0], [-4, 0]]
BED = [0.0, 0.3, -3.0, 1.8, 0.6, 2.0]
CLASSES = ("void", "bed", "nightstand", "ceiling_lamp")


def items(*boxes: list[float], back: int = 0) -> Furniture:
    return furniture(np.array(boxes), np.full(len(boxes), back))


def furniture(boxes: np.ndarray, back: np.ndarray, labels: object = 0) -> Furniture:
    return Furniture(
        boxes, np.broadcast_to(np.array(labels, dtype=np.int64), len(boxes)), back, -OUTWARD[back]
    )


def at(x: float, z: float, y: float = 0.25) -> list[float]:
    return [x, y, z, 0.5, 0.5, 0.5]


@pytest.mark.parametrize(
    ("relation", "holds", "fails"),
    [
        ("beside", [at(1.2, -3.7), at(-1.6, -2.5)], [at(1.7, -3.0), at(1.2, -1.5), at(0, -1.7)]),
        ("in front of", [at(0, -1.5), at(1.0, -1.9)], [at(0, 0.1), at(1.2, -2.5), at(0, -4.5)]),
        ("near", [at(1.2, -3.0), at(0, -0.8)], [at(2.2, -3.0), at(2.0, -0.9)]),
        ("far from", [at(0, 0.1), at(3.1, -3.0)], [at(0, -0.1), at(2.9, -3.0)]),
        ("under", [], [at(0, -3.0)]),
    ],
)
def test_relations_to_a_bed_that_faces_high_z(relation, holds, fails):
    found = related(relation, items(*holds, *fails), items(BED), "bed")[:, 0]
    assert found.tolist() == [True] * len(holds) + [False] * len(fails)


@pytest.mark.parametrize("quarters", range(4))
@pytest.mark.parametrize("relation", ["beside", "in front of", "facing", "near", "far from"])
def test_relations_turn_with_the_room(relation, quarters):
    rng = np.random.default_rng(1)
    boxes = np.concatenate([rng.uniform(-3, 3, (50, 3)), rng.uniform(0.2, 1.5, (50, 3))], axis=1)
    back = rng.integers(4, size=50)
    turned = boxes.copy()
    for _ in range(quarters):  # +z to +x
        x, z = turned[:, 0].copy(), turned[:, 2].copy()
        turned[:, 0], turned[:, 2] = z, -x
        turned = turned[:, [0, 1, 2, 5, 4, 3]]
    plain = furniture(boxes, back)
    other = furniture(turned, (back + quarters) % 4)
    found = related(relation, plain, plain, "bed")
    assert found.any() and not found.all()
    assert (related(relation, other, other, "bed") == found).all()


def test_under_a_lamp_and_under_a_window():
    lamp = items([0.1, 2.0, -3.0, 0.4, 0.4, 0.4])
    assert related("under", items(BED), lamp, "lamp")[0, 0]
    assert not related("under", items(at(1.0, -3.0)), lamp, "lamp")[0, 0]
    window = Opening("window", (1.0, -4.0), (2.2, -4.0), 0.9, 2.1)
    there = opening_items(RoomShape(Floor(read_floor(FLOOR)), (window,)), "window")
    tall = [1.6, 0.5, -3.7, 0.5, 1.0, 0.5]
    found = related(
        "under", items(at(1.6, -3.7), at(1.6, -3.0), at(2.6, -3.7), tall), there, "window"
    )
    assert found[:, 0].tolist() == [True, False, False, False]


def test_walls_and_corners_are_those_of_the_floor():
    floor = Floor(read_floor(FLOOR))
    own = items(at(-3.7, -2), at(-3.7, -3.7), at(-0.3, -0.4), at(-2, -2), at(0.4, 0.5))
    walls = related_to_room("at a wall", own, floor).tolist()
    assert walls == [True, True, True, False, True]
    corners = related_to_room("in a corner", own, floor).tolist()
    assert corners == [False, True, False, False, False]  # (0, 0) points into the room


def test_a_wish_can_hold_while_objects_come_that_may_meet_it():
    wish = RelationWish("nightstand", "beside", "bed", 2)
    relations = RelationChecks([wish], RoomShape(Floor(read_floor(FLOOR))), CLASSES)

    def placed(*each: tuple[int, list[float]]) -> Furniture:
        boxes = np.array([row for _, row in each]).reshape(-1, 6)
        return furniture(boxes, np.zeros(len(each), int), [label for label, _ in each])

    near, far = at(1.2, -3.0), at(3.5, 3.0)
    both = placed((2, near), (2, far))
    bed = placed((1, BED))
    assert relations.can_hold(2, both, bed, [2]).tolist() == [True, False]
    assert relations.can_hold(2, both, bed, [2, 2]).tolist() == [True, True]
    assert relations.can_hold(2, both, placed(), [2, 1]).tolist() == [True, True]
    assert relations.can_hold(3, placed((3, far)), bed, [2]).tolist() == [True]
    assert relations.held(placed((1, BED), (2, near), (2, at(-1.2, -3.0)))) == [True]
    assert relations.held(placed((1, BED), (2, near), (2, far))) == [False]

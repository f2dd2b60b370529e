"""Relations at places where they barely hold and barely fail, and in partly furnished rooms."""

from itertools import product

import numpy as np
import pytest

from sceneprior.core.arrangements import findings
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

    near, far = at(1.2, -3.7), at(3.5, 3.0)
    bed = (1, BED)
    assert relations.can_hold(2, placed(bed, (2, near)), [2])
    assert not relations.can_hold(2, placed(bed, (2, far)), [2])
    assert relations.can_hold(2, placed(bed, (2, far)), [2, 2])
    assert relations.can_hold(2, placed((2, far)), [2, 1])
    assert relations.can_hold(3, placed(bed, (3, far)), [2, 2])
    assert not relations.can_hold(3, placed(bed, (3, far)), [2])
    assert not relations.can_hold(1, placed((1, [-3.1, *BED[1:]])), [2, 2]), "a wall is at its side"
    assert not relations.can_hold(1, placed(bed, (1, [1.2, *BED[1:]])), [2, 2])
    assert relations.held(placed((1, BED), (2, near), (2, at(-1.2, -3.7)))) == [True]
    assert relations.held(placed((1, BED), (2, near), (2, at(-1.2, -2.3)))) == [False]
    assert relations.held(placed((1, BED), (2, near), (2, far))) == [False]


def held(relation: str, subject: str, target: str | None, *placed: tuple, count: int = 1) -> bool:
    """A relation of a room on `FLOOR` with objects (label, back, box)."""
    classes = ("void", "bed", "nightstand", "wardrobe", "table", "chair", "sofa")
    boxes = np.array([box for _, _, box in placed])
    labels = [classes.index(label) for label, _, _ in placed]
    own = furniture(boxes, np.array([back for _, back, _ in placed]), labels)
    wish = RelationWish(subject, relation, target, count)
    return RelationChecks([wish], RoomShape(Floor(read_floor(FLOOR))), classes).held(own)[0]


def test_pairs_at_a_head_are_the_yardsticks_pairs():
    """Two nightstands anywhere about a bed that faces high z."""
    xs, zs = (-1.6, -1.2, 1.2, 1.45, 1.5), (-3.95, -3.55, -3.45, -3.0, -2.0)
    places, seen = list(product(xs, zs)), set()
    for one, other in product(places, places):
        room = [("bed", 0, BED), *(("nightstand", 0, at(*place)) for place in (one, other))]
        found = held("on both sides of", "nightstand", "bed", *room, count=2)
        pieces = furniture(np.array([box for *_, box in room]), np.zeros(3, int), [0, 1, 1])
        (pair,) = findings(pieces.pieces(("bed", "nightstand")), None)["pairs_at_bed"]
        assert found == pair.holds
        seen.add(found)
    assert seen == {True, False}


WARDROBE = [-1.0, 1.0, -3.7, 1.2, 2.0, 0.6]


@pytest.mark.parametrize(
    ("back", "z", "blocked", "holds"),
    [(0, -3.7, False, True), (2, -3.7, False, False), (0, -3.55, False, False),
     (0, -3.7, True, False)],
)  # fmt: skip
@pytest.mark.parametrize("relation", ["at a wall", "with a free front"])
def test_a_wardrobe_at_a_wall_has_its_back_to_it_and_its_front_free(
    relation, back, z, blocked, holds
):
    box = [*WARDROBE[:2], z, *WARDROBE[3:]]
    room = [("wardrobe", back, box)]
    if blocked:
        room.append(("sofa", 0, [-1.0, 0.4, -2.9, 1.6, 0.8, 0.8]))
    assert held(relation, "wardrobe", None, *room) == holds
    if not blocked:
        assert held("back to a wall", "wardrobe", None, *room) == holds


@pytest.mark.parametrize(
    ("relation", "room", "holds"),
    [
        ("at", [("chair", 2, [0, 0.4, 1.5, 0.5, 0.9, 0.5])], True),
        ("at", [("chair", 0, [0, 0.4, 1.5, 0.5, 0.9, 0.5])], False),
        ("at", [("chair", 2, [0, 0.4, 1.7, 0.5, 0.9, 0.5])], False),
        ("against", [("chair", 0, [0, 0.4, 1.5, 0.5, 0.9, 0.5])], True),
        ("on both sides of", [("chair", 2, [0, 0.4, 1.5, 0.5, 0.9, 0.5]),
                              ("chair", 0, [0, 0.4, 0.5, 0.5, 0.9, 0.5])], True),
        ("on both sides of", [("chair", 2, [-0.3, 0.4, 1.5, 0.5, 0.9, 0.5]),
                              ("chair", 2, [0.3, 0.4, 1.5, 0.5, 0.9, 0.5])], False),
    ],
)  # fmt: skip
def test_chairs_at_a_table(relation, room, holds):
    table = ("table", 1, [0.0, 0.4, 1.0, 1.6, 0.8, 0.5])
    assert held(relation, "chair", "table", table, *room, count=len(room)) == holds


def test_opposite_and_at_the_foot():
    bed = ("bed", 0, BED)
    sofa = [0.0, 0.4, -1.5, 1.6, 0.8, 0.8]
    assert held("opposite", "sofa", "bed", bed, ("sofa", 2, sofa))
    assert not held("opposite", "sofa", "bed", bed, ("sofa", 0, sofa))
    assert held("at the foot of", "sofa", "bed", bed, ("sofa", 0, sofa))
    assert not held("at the foot of", "sofa", "bed", bed, ("sofa", 0, [1.8, *sofa[1:]]))
    assert not held("at the foot of", "sofa", "bed", bed, ("sofa", 0, [0.0, 0.4, -1.0, *sofa[3:]]))


def test_no_bed_is_beside_another_where_there_is_none():
    wish = RelationWish("bed", "beside", "bed", 1)
    checks = RelationChecks([wish], RoomShape(Floor(read_floor(FLOOR))), CLASSES)
    assert checks.held(furniture(np.zeros((0, 6)), np.zeros(0, dtype=np.int64))) == [False]

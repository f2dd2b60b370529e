"""Checks of function, each on a room in which it holds and on rooms with one thing changed."""

import math
from dataclasses import replace

import numpy as np
import pytest
from toy_metrics import compared_with, room_set

from sceneprior.core.ground_truth import _turned
from sceneprior.core.scene import Scene, SceneObject, Turned, bound_m
from sceneprior.evaluation.metrics import METRICS
from sceneprior.evaluation.metrics.function import Habits, checks

FLOOR = np.array([[-2.5, -2.0], [2.5, -2.0], [2.5, 2.0], [-2.5, 2.0]])
NORTH, EAST, SOUTH, WEST = 0.0, math.pi / 2, math.pi, -math.pi / 2
"""Yaws of pieces whose front points along +z, +x, -z and -x."""


def piece(label: str, x: float, z: float, yaw: float, size=(1.0, 0.8, 0.5)) -> SceneObject:
    turned = Turned(yaw, size)
    return SceneObject(label, (float(x), size[1] / 2, float(z)), bound_m(turned), turned=turned)


def bedroom(**changed: SceneObject | None) -> Scene:
    """A bed at the south wall between two nightstands, a screen before it, a desk with a chair."""
    named = {
        "bed": piece("double_bed", 0, -0.95, NORTH, (1.6, 0.5, 2.0)),
        "left": piece("nightstand", -1.1, -1.75, NORTH, (0.4, 0.5, 0.4)),
        "right": piece("nightstand", 1.1, -1.75, NORTH, (0.4, 0.5, 0.4)),
        "screen": piece("tv_stand", 0, 1.75, SOUTH, (1.2, 0.5, 0.4)),
        "desk": piece("desk", -2.2, 0.9, EAST, (1.2, 0.75, 0.6)),
        "chair": piece("chair", -1.6, 0.9, WEST, (0.5, 0.9, 0.5)),
        "wardrobe": piece("wardrobe", 2.2, 1.2, WEST, (1.2, 2.0, 0.6)),
    } | changed
    objects = tuple(item for item in named.values() if item is not None)
    return Scene("room", "front3d_bedroom", objects, FLOOR)


HABITS = Habits.of([bedroom()] * 20)
FAILING = {
    "pairs_at_bed": {"left": piece("nightstand", 1.1, -1.2, NORTH, (0.4, 0.5, 0.4))},
    "chairs_at_tables": {"chair": piece("chair", -0.9, 0.9, WEST, (0.5, 0.9, 0.5))},
    "chairs_turned": {"chair": piece("chair", -1.6, 0.9, EAST, (0.5, 0.9, 0.5))},
    "tables_with_chairs": {"chair": None},
    "screens_seen": {"screen": piece("tv_stand", 0, 1.75, NORTH, (1.2, 0.5, 0.4))},
    "fronts_free": {"wardrobe": piece("wardrobe", 2.2, 1.2, EAST, (1.2, 2.0, 0.6))},
    "backs_covered": {"wardrobe": piece("wardrobe", 1.9, 1.2, WEST, (1.2, 2.0, 0.6))},
    "usual_numbers": {"second": piece("single_bed", 0, 0.6, NORTH, (0.9, 0.5, 0.2))},
    "usual_sizes": {"wardrobe": piece("wardrobe", 2.4, 1.2, WEST, (1.2, 2.0, 0.2))},
    "usual_places": {"wardrobe": piece("wardrobe", 0.5, 0.5, WEST, (1.2, 2.0, 0.6))},
}


def failed(scene: Scene) -> set[str]:
    return {key for key, outcomes in checks(scene, HABITS).items() if not all(outcomes)}


def test_a_sensible_room_has_no_fault():
    assert failed(bedroom()) == set()
    assert HABITS.faults == set(FAILING)
    outcomes = checks(bedroom(), HABITS)
    assert all(outcomes[key] for key in FAILING), "every check applies to this room"


@pytest.mark.parametrize("key", FAILING)
def test_one_change_fails_its_check(key):
    assert key in failed(bedroom(**FAILING[key]))


def test_checks_do_not_hang_on_the_frame():
    """A room turned by a quarter, and each faulty one, has the same outcomes."""

    def turned(scene: Scene) -> Scene:
        objects = tuple(
            piece(o.label, o.center_m[2], -o.center_m[0], o.turned.yaw_rad + EAST, o.turned.size_m)
            for o in scene.objects
        )
        floor = np.stack([scene.floor_m[:, 1], -scene.floor_m[:, 0]], axis=1)
        return replace(scene, objects=objects, floor_m=floor)

    for changed in ({}, *FAILING.values()):
        scene = bedroom(**changed)
        assert checks(turned(scene), HABITS) == checks(scene, HABITS)


def test_what_is_unknown_is_not_judged():
    bare = replace(bedroom(), floor_m=None)
    plain = replace(bare, objects=tuple(replace(item, turned=None) for item in bare.objects))
    assert not {"fronts_free", "backs_covered", "usual_places"} & checks(bare, HABITS).keys()
    assert checks(plain, HABITS)["screens_seen"] == []
    assert failed(plain) == set()


def test_habits_of_real_rooms_are_no_faults():
    """Desks without a chair in half of the training rooms are no fault; in none, they are."""
    with_chair, without = bedroom(), bedroom(chair=None)
    scores = {}
    for name, train in (("half", [with_chair, without] * 10), ("all", [with_chair] * 20)):
        comparison = compared_with(room_set([with_chair] * 2), train=train)
        rooms = room_set([without, with_chair])
        functions = {m.function for m in METRICS if m.key in ("rooms_without_fault", *FAILING)}
        (function,) = functions
        scores[name] = {key: found.value for key, found in function(rooms, comparison).items()}
    assert scores["half"]["tables_with_chairs"] == scores["all"]["tables_with_chairs"] == 0.5
    assert scores["half"]["rooms_without_fault"] == 1.0
    assert scores["all"]["rooms_without_fault"] == 0.5


def test_boxes_at_a_yaw_have_the_extents_of_the_ground_truth():
    for yaw in np.linspace(-3, 3, 40):
        own = (1.3, 0.8, 0.6)
        found = _turned(yaw, bound_m(Turned(yaw, own)))
        assert bound_m(found) == pytest.approx(bound_m(Turned(yaw, own)), abs=0.08)
        if abs(math.cos(2 * yaw)) > 0.1:
            assert found.size_m == pytest.approx(own, abs=1e-6)

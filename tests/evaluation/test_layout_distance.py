"""Layout distances against closed forms and against all pairings tried out."""

from itertools import permutations

import numpy as np
import pytest

from sceneprior.core.scene import Scene, SceneObject
from sceneprior.evaluation.metrics.novelty import nearest_distances

LABELS = ("desk", "chair", "sofa")


def room(*rows) -> Scene:
    objects = tuple(
        SceneObject(label, tuple(map(float, center)), tuple(map(float, size)))
        for label, center, size in rows
    )
    return Scene("a", "front3d_bedroom", objects)


def random_room(rng: np.random.Generator, most: int = 5) -> Scene:
    return room(
        *(
            (LABELS[rng.integers(3)], rng.uniform(-0.6, 0.6, 3), rng.uniform(0.3, 0.9, 3))
            for _ in range(rng.integers(0, most))
        )
    )


def by_all_pairings(a: Scene, b: Scene) -> float:
    if len(a.objects) > len(b.objects):
        a, b = b, a
    if not b.objects:
        return 0.0

    def cost(x: SceneObject, y: SceneObject) -> float:
        apart = np.subtract(x.center_m + x.size_m, y.center_m + y.size_m)
        return min(1.0, float(np.linalg.norm(apart))) if x.label == y.label else 1.0

    totals = [
        sum(cost(x, y) for x, y in zip(a.objects, chosen, strict=True))
        for chosen in permutations(b.objects, len(a.objects))
    ]
    return (min(totals) + len(b.objects) - len(a.objects)) / len(b.objects)


def turned(scene: Scene) -> Scene:
    """A quarter turn about y, +z towards +x."""
    objects = [
        (item.label, (item.center_m[2], item.center_m[1], -item.center_m[0]), item.size_m[::-1])
        for item in scene.objects
    ]
    return room(*((label, center, size) for label, center, size in objects))


def mirrored(scene: Scene) -> Scene:
    """The mirror image, left and right exchanged."""
    objects = [
        (item.label, (-item.center_m[0], *item.center_m[1:]), item.size_m) for item in scene.objects
    ]
    return room(*objects)


def eight(scene: Scene) -> list[Scene]:
    found = [scene, mirrored(scene)]
    for _ in range(3):
        found += [turned(found[-2]), turned(found[-1])]
    return found


def test_the_nearest_room_is_found_among_all_turned_or_mirrored(rng):
    # The last is empty: it has no object to start at.
    training = [*(random_room(rng) for _ in range(30)), room()]
    scenes = [*(random_room(rng, 6) for _ in range(15)), room()]
    for scene in scenes[:5]:
        for other in training[:5]:
            expected = min(by_all_pairings(turn, other) for turn in eight(scene))
            assert nearest_distances([scene], [other])[0] == pytest.approx(expected, abs=1e-9)
    got = nearest_distances(scenes, training)
    for scene, distance in zip(scenes, got, strict=True):
        expected = min(by_all_pairings(turn, other) for turn in eight(scene) for other in training)
        assert distance == pytest.approx(expected, abs=1e-9)


DESK, CHAIR = ("desk", (0, 0, 0), (1, 1, 1)), ("chair", (2, 0, 0), (1, 1, 1))


def test_copies_hold_the_same_furniture_and_one_odd_object_costs_nothing():
    moved = ("chair", (2.5, 0, 0), (1, 1, 1))

    def apart(scene, *training):
        return nearest_distances([scene], training, as_copies=True)[0]

    assert apart(room(DESK, CHAIR), room(moved, DESK)) == pytest.approx(0.25)
    sofa = ("sofa", (5, 0, 5), (1, 1, 1))
    # A sofa more, on either side: the pairs that are left count, and they alone.
    assert apart(room(DESK, CHAIR, sofa), room(moved, DESK)) == pytest.approx(0.25)
    assert apart(room(DESK, CHAIR), room(sofa, moved, DESK)) == pytest.approx(0.25)
    # One object replaced is two that differ; an empty room is a copy of nothing.
    assert apart(room(DESK, CHAIR), room(DESK, sofa)) == np.inf
    assert apart(room(DESK), room()) == apart(room(), room(DESK)) == apart(room(), room()) == np.inf
    # Otherwise, one missing object of two is as near as can be.
    assert nearest_distances([room(DESK, DESK)], [room(DESK)])[0] == 0.5

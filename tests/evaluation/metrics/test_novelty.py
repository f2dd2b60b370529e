"""Layout distances against closed forms and against all pairings tried out."""

from itertools import permutations

import numpy as np
import pytest

from sceneprior.evaluation.metrics.novelty import layout_distance, nearest_distances
from sceneprior.scene import Scene, SceneObject

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


def test_distances_of_random_rooms_are_those_of_the_best_pairing(rng):
    for _ in range(60):
        a, b = random_room(rng), random_room(rng)
        assert layout_distance(a, b) == pytest.approx(by_all_pairings(a, b), abs=1e-12)
        assert layout_distance(b, a) == pytest.approx(layout_distance(a, b), abs=1e-12)


def test_empty_and_unlike_rooms_have_defined_distances():
    chair = room(("chair", (0, 0, 0), (1, 1, 1)))
    desk = room(("desk", (0, 0, 0), (1, 1, 1)))
    assert layout_distance(room(), room()) == 0
    assert layout_distance(chair, room()) == layout_distance(chair, desk) == 1
    assert layout_distance(chair, chair) == 0


def turned(scene: Scene) -> Scene:
    """A quarter turn about y, +z towards +x."""
    objects = [
        (item.label, (item.center_m[2], item.center_m[1], -item.center_m[0]), item.size_m[::-1])
        for item in scene.objects
    ]
    return room(*((label, center, size) for label, center, size in objects))


def test_the_nearest_room_is_found_among_all_in_any_quarter_turn(rng):
    # The last is empty: it has no object to start at.
    training = [*(random_room(rng) for _ in range(30)), room()]
    scenes = [*(random_room(rng, 6) for _ in range(15)), room()]
    got = nearest_distances(scenes, training)
    for scene, distance in zip(scenes, got, strict=True):
        four = [scene]
        for _ in range(3):
            four.append(turned(four[-1]))
        expected = min(by_all_pairings(turn, other) for turn in four for other in training)
        assert distance == pytest.approx(expected, abs=1e-9)


def test_a_turned_copy_is_no_news_and_a_training_room_passes_itself_over(rng):
    training = [random_room(rng) for _ in range(20)]
    copies = [turned(scene) for scene in training]
    np.testing.assert_allclose(nearest_distances(copies, training), 0, atol=1e-9)
    rows = [3, 7, 11]
    apart = nearest_distances([training[row] for row in rows], training, own=rows)
    for row, distance in zip(rows, apart, strict=True):
        rest = training[:row] + training[row + 1 :]
        expected = nearest_distances([training[row]], rest)[0]
        assert distance == pytest.approx(expected, abs=1e-12)

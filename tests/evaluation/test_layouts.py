"""Layouts: distances to the nearest room by all pairings, the classifier's folds, known floors."""

from itertools import permutations

import numpy as np
import pytest
from toy_metrics import compared_with, room, room_set

from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.shell import floor_polygon
from sceneprior.evaluation.metrics import layouts
from sceneprior.evaluation.metrics.layouts import layout_classifier_accuracy
from sceneprior.evaluation.metrics.novelty import TURNS, nearest_distances
from sceneprior.evaluation.metrics.placement import between_furniture, walkable_share

LABELS = ("desk", "chair", "sofa")
FLOOR = np.array([[-2.0, -1], [2, -1], [2, 1], [-2, 1]])


def random_room(rng: np.random.Generator, most: int = 5) -> Scene:
    drawn = [
        (LABELS[rng.integers(3)], rng.uniform(-0.6, 0.6, 3)) for _ in range(rng.integers(0, most))
    ]
    return room(*drawn, sizes=[rng.uniform(0.3, 0.9, 3) for _ in drawn])


def by_all_pairings(a: Scene, b: Scene) -> float:
    """Layout distance in the best of all turns, mirror images and pairings, tried one by one."""

    def cost(x: SceneObject, y: SceneObject, turn: np.ndarray) -> float:
        moved = np.concatenate([x.center_m @ turn, x.size_m @ np.abs(turn)])
        apart = np.linalg.norm(moved - [*y.center_m, *y.size_m])
        return min(1.0, float(apart)) if x.label == y.label else 1.0

    number = max(len(a.objects), len(b.objects))
    fewer = min(len(a.objects), len(b.objects))
    totals = [
        sum(cost(x, y, turn) for x, y in zip(mine, theirs, strict=True)) + number - fewer
        for turn in TURNS
        for mine in permutations(a.objects, fewer)
        for theirs in ([b.objects] if fewer == len(b.objects) else permutations(b.objects, fewer))
    ]
    return min(totals) / max(number, 1)


def test_the_nearest_room_is_found_among_all_turned_or_mirrored(rng):
    # The last is empty: it has no object to start at.
    training = [*(random_room(rng) for _ in range(12)), room()]
    scenes = [*(random_room(rng) for _ in range(12)), room()]
    apart = np.array([[by_all_pairings(a, b) for b in training] for a in scenes])
    np.testing.assert_allclose(nearest_distances(scenes, training), apart.min(axis=1), atol=1e-9)
    for column, other in enumerate(training[-3:], len(training) - 3):
        found = nearest_distances(scenes, [other])
        np.testing.assert_allclose(found, apart[:, column], atol=1e-9)
    for turn in TURNS:  # they are turns and mirror images, and no two are alike
        np.testing.assert_array_equal(turn @ turn.T, np.eye(3))
    assert len(np.unique(np.array(TURNS), axis=0)) == 8


def test_copies_hold_the_same_furniture_and_one_odd_object_costs_nothing():
    desk, chair, moved = ("desk", (0, 0, 0)), ("chair", (2, 0, 0)), ("chair", (2.5, 0, 0))
    sofa = ("sofa", (5, 0, 5))
    for mine, theirs, expected in (
        ((desk, chair), (moved, desk), 0.25),
        # A sofa more, on either side: the pairs that are left count, and they alone.
        ((desk, chair, sofa), (moved, desk), 0.25),
        ((desk, chair), (sofa, moved, desk), 0.25),
        # One object replaced is two that differ; an empty room is a copy of nothing.
        ((desk, chair), (desk, sofa), np.inf),
        ((desk,), (), np.inf),
        ((), (), np.inf),
    ):
        found = nearest_distances([room(*mine)], [room(*theirs)], as_copies=True)
        assert found[0] == pytest.approx(expected)


def test_both_sides_weigh_alike_and_no_judged_room_is_learnt_from(rng, monkeypatch):
    asked: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def remember(features, labels, others, seed):
        asked.append((features, labels, others))
        return np.ones(len(others), dtype=int)

    monkeypatch.setattr(layouts, "boosted_trees", remember)
    rooms = [
        room(("desk", (x, 0.5, z)), ("chair", (x + 0.8, 0.5, z)), ("double_bed", (u, 0.4, v)))
        for x, z, u, v in rng.uniform(-2, 2, (380, 4))
    ]
    comparison = compared_with(room_set(rooms[:60]), train=rooms[60:180])
    # Always the same answer is right half of the time, however many rooms there are.
    assert layout_classifier_accuracy(room_set(rooms[180:]), comparison).value == 0.5
    assert len(asked) == 5
    for features, labels, others in asked:
        assert np.bincount(labels).tolist() == [120, 120], "at most as many as real rooms"
        assert len(others) == 60 + 40
        assert not (others[:, None] == features).all(axis=2).any()
    fresh = np.concatenate([others[60:] for *_, others in asked])
    assert len(np.unique(fresh, axis=0)) == 200, "each judged once"


@pytest.mark.parametrize(("generated", "train"), [(1, 8), (0, 2), (0, 3)])
def test_one_room_is_too_few_for_the_classifier(rng, generated, train):
    """One generated room, and halves of two and three training rooms."""
    real = [random_room(rng) for _ in range(train)]
    rooms = room_set([random_room(rng) for _ in range(generated)] or real)
    comparison = compared_with(room_set([random_room(rng)]), train=real)
    assert layout_classifier_accuracy(rooms, comparison).value is None


def piece(x: float, z: float, width: float, depth: float) -> SceneObject:
    return SceneObject("desk", (x, 0.5, z), (width, 1.0, depth))


def test_a_wall_of_furniture_parts_the_floor_in_known_areas():
    def share(*objects: SceneObject) -> float | None:
        scene = Scene("a", "front3d_bedroom", objects, FLOOR)
        return walkable_share(scene, floor_polygon(scene))

    # 4 x 2 m; a shelf across from x = 0 to 0.5. A disc of 0.2 m stands on 1.6 m x 1.6 m to the
    # left and 1.1 m x 1.6 m to the right: the shelf's corners lie in the walls.
    assert share(piece(0.25, 0.0, 0.5, 2.0)) == pytest.approx(1.6 / 2.7, abs=1e-9)
    # 0.39 m are not enough for a disc of 0.4 m, 0.41 m are.
    assert share(piece(0.25, -0.195, 0.5, 1.61)) < 1 == share(piece(0.25, -0.205, 0.5, 1.59))
    # Without a floor, the rectangle around furniture takes its place: 1.4 and 1.2 m wide.
    ends = piece(-1.9, 0.0, 0.2, 2.0), piece(1.9, 0.0, 0.2, 2.0)
    parted = Scene("a", "front3d_bedroom", (*ends, piece(0.1, 0.0, 0.2, 2.0)))
    assert between_furniture(parted) == pytest.approx(1.4 / 2.6, abs=1e-9)
    assert between_furniture(Scene("a", "front3d_bedroom", ends[:1])) is None

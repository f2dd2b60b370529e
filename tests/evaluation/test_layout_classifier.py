"""The layout classifier's features by hand, what they must not see, and two known accuracies."""

import numpy as np
import pytest
from toy_metrics import compared_with, room, room_set

from sceneprior.core.classes import label_set
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metrics import layouts
from sceneprior.evaluation.metrics.layouts import (
    ABSENT,
    layout_classifier_accuracy,
    layout_features,
)

CLASSES = label_set("front3d_bedroom")
DESK, CHAIR = CLASSES.index("desk"), CLASSES.index("chair")
UPPER = list(zip(*np.triu_indices(len(CLASSES)), strict=True))


def features_of(scene: Scene) -> np.ndarray:
    return layout_features(scene.centers_m, scene.sizes_m, scene.class_indices, len(CLASSES))


def named(features: np.ndarray) -> dict[str, np.ndarray]:
    """The parts of a row by name; pairs as (first class, second class) -> value."""
    n = len(CLASSES)
    singles = dict(zip(("count", "height", "edge", "other_edge"), features.reshape(-1)[: 4 * n]
                       .reshape(4, n), strict=True))  # fmt: skip
    pairs = features[4 * n :].reshape(3, -1)
    return singles | dict(zip(("gap", "shared", "misaligned"), pairs, strict=True))


def test_features_by_hand():
    # Unit cubes; the second chair shares a quarter of the desk, the first stands 3 m away.
    scene = room(("desk", (0, 0.5, 0)), ("chair", (4, 0.5, 3)), ("chair", (0.5, 0.5, -0.5)))
    got = named(features_of(scene))
    assert got["count"][[DESK, CHAIR]].tolist() == [1, 2] and got["count"].sum() == 3
    assert got["height"][DESK] == 0.5 and got["height"][CLASSES.index("sofa")] == ABSENT
    # x from -0.5 to 4.5, z from -1 to 3.5.
    assert (got["edge"][DESK], got["other_edge"][DESK]) == (0.0, 0.5)
    assert (got["edge"][CHAIR], got["other_edge"][CHAIR]) == (0.0, 0.25)
    both = UPPER.index(tuple(sorted((DESK, CHAIR))))
    chairs = UPPER.index((CHAIR, CHAIR))
    assert (got["gap"][both], got["shared"][both]) == (0.0, 0.25)
    assert got["misaligned"][both] == 0.5
    assert got["gap"][chairs] == pytest.approx(np.hypot(2.5, 2.5))
    assert got["misaligned"][chairs] == 3.5 and got["shared"][chairs] == 0
    assert got["gap"][UPPER.index((DESK, DESK))] == ABSENT
    assert (features_of(room())[len(CLASSES) :] == ABSENT).all()


def random_rooms(rng, count: int) -> list[Scene]:
    """A chair beside its desk, a bed anywhere."""
    rooms = []
    for _ in range(count):
        x, z = rng.uniform(-2, 2, 2)
        bed = rng.uniform(-2, 2, 2)
        rooms.append(
            room(
                ("desk", (x, 0.5, z)),
                ("chair", (x + 0.8, 0.5, z)),
                ("double_bed", (bed[0], 0.4, bed[1])),
            )
        )
    return rooms


def test_turns_mirror_images_moves_and_the_order_of_objects_change_nothing(rng):
    for scene in random_rooms(rng, 10):
        items = [(o.label, np.array(o.center_m), (1.0, 0.8, 1.4)) for o in scene.objects]

        def built(change, resize=lambda size: size, items=items):
            return room(
                *((label, change(at)) for label, at, _ in items),
                sizes=[resize(size) for _, _, size in items],
            )

        expected = features_of(built(lambda at: at))
        for changed in (
            built(lambda at: at * (-1, 1, 1)),
            built(lambda at: (at[2], at[1], -at[0]), lambda size: size[::-1]),
            built(lambda at: np.add(at, (1.0, 0, -2.0))),
        ):
            np.testing.assert_allclose(features_of(changed), expected, atol=1e-12)
        reordered = built(lambda at: at)
        reordered = Scene("a", "front3d_bedroom", reordered.objects[::-1])
        np.testing.assert_allclose(features_of(reordered), expected, atol=1e-12)


def test_both_sides_weigh_alike_and_no_judged_room_is_learnt_from(rng, monkeypatch):
    asked: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def remember(features, labels, others, seed):
        asked.append((features, labels, others))
        return np.ones(len(others), dtype=int)

    monkeypatch.setattr(layouts, "boosted_trees", remember)
    test, real = room_set(random_rooms(rng, 60)), random_rooms(rng, 120)
    found = layout_classifier_accuracy(
        room_set(random_rooms(rng, 200)), compared_with(test, train=real)
    )
    # Always the same answer is right half of the time, however many rooms there are.
    assert found.value == 0.5 and len(asked) == 5
    for features, labels, others in asked:
        assert np.bincount(labels).tolist() == [120, 120], "at most as many as real rooms"
        assert len(others) == 60 + 40
        assert not (others[:, None] == features).all(axis=2).any()
    fresh = np.concatenate([others[60:] for *_, others in asked])
    assert len(np.unique(fresh, axis=0)) == 200, "each judged once"

"""Requested rooms of a shipped prior: floors, counts, and what stays as it was."""

import numpy as np
import pytest
import shapely

import sceneprior
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.errors import InputWarning
from sceneprior.core.scene import Scene
from sceneprior.lifted.sampled import scene_of
from sceneprior.lifted.sampler.draw import draw_rooms

L_SHAPE = [[0, 0], [5, 0], [5, 3], [2.5, 3], [2.5, 6], [0, 6]]
EDGE_M = 0.015
"""Furniture may extend beyond the floor by a centimetre."""


@pytest.fixture(scope="module")
def prior():
    return sceneprior.load("procthor-bedroom")


def labels(room: Scene) -> list[str]:
    return [item.label for item in room.objects]


def footprints(room: Scene) -> np.ndarray:
    low, high = room.centers_m - room.sizes_m / 2, room.centers_m + room.sizes_m / 2
    return shapely.box(low[:, 0], low[:, 2], high[:, 0], high[:, 2])


def same(a: Scene, b: Scene) -> bool:
    alike = labels(a) == labels(b) and (a.centers_m == b.centers_m).all()
    return bool(alike and (a.sizes_m == b.sizes_m).all())


def test_rooms_without_a_request_are_those_of_the_sampler_to_the_bit(prior):
    drawn = draw_rooms(prior.trained.sampler, 4, 3)
    prior.sample(2, seed=3, floor="4x3")  # leaves nothing behind
    for row, room in enumerate(prior.sample(4, seed=3)):
        assert same(room, scene_of(prior.trained, room.name, drawn, row))
    assert all(map(same, prior.sample(4, seed=3), sample_rooms(prior.trained, 4, 3)))


def test_a_seed_draws_the_same_rooms_the_first_however_many_follow(prior):
    some = prior.sample(2, seed=1, floor="4x3", want={"desk": 1})
    more = prior.sample(5, seed=1, floor="4x3", want={"desk": 1})
    for a, b in zip(some, more[:2], strict=True):
        assert labels(a) == labels(b)
        np.testing.assert_allclose(a.centers_m, b.centers_m, atol=1e-4)
    assert not same(more[0], more[1])


@pytest.mark.parametrize(
    ("floor", "said"), [("1x1", "1.0 square metres is smaller"), ("40x40", "is larger")]
)
def test_floors_unlike_those_of_training_rooms_are_noted(prior, floor, said):
    with pytest.warns(InputWarning, match=f"{said} than in nearly all training rooms"):
        prior.sample(1, floor=floor)


def test_usual_floors_and_drawn_ones_are_not_noted(prior, recwarn):
    prior.sample(1, floor="4x3")
    prior.sample(1, want={"double_bed": 1})
    assert not [each for each in recwarn if issubclass(each.category, InputWarning)]


@pytest.mark.parametrize("floor", ["4x3", L_SHAPE, [[0, 0], [4, 0], [5, 3], [2, 4], [0, 3]]])
def test_furniture_stays_on_the_floor(prior, floor):
    for room in prior.sample(4, seed=0, floor=floor):
        assert room.objects and room.floor_m is not None
        assert np.allclose(room.floor_m.min(axis=0) + room.floor_m.max(axis=0), 0)
        on = shapely.Polygon(room.floor_m).buffer(EDGE_M, join_style="mitre")
        assert on.covers(footprints(room)).all()


def test_counts_hold_exactly(prior):
    want = {"double_bed": 1, "single_bed": 0, "nightstand": 2, "desk": ">=1", "cabinet": "<=1"}
    for room in prior.sample(6, seed=0, floor="5x4", want=want):
        found = labels(room)
        assert [found.count(label) for label in list(want)[:3]] == [1, 0, 2]
        assert found.count("desk") >= 1 and found.count("cabinet") <= 1
        assert room.extra["wishes"][2] == {"wish": "2 nightstand", "holds": True}


def test_small_rooms_hold_less(prior):
    small, large = (prior.sample(12, seed=0, floor=floor) for floor in ("3x3", "6x6"))
    assert sum(map(len, map(labels, small))) < sum(map(len, map(labels, large)))


def test_without_a_floor_a_rectangle_is_drawn(prior):
    rooms = prior.sample(3, seed=2, want={"double_bed": 2})
    assert [labels(room).count("double_bed") for room in rooms] == [2, 2, 2]
    assert len({room.floor_m.max() for room in rooms}) == 3
    for room in rooms:
        on = shapely.Polygon(room.floor_m).buffer(EDGE_M, join_style="mitre")
        assert on.covers(footprints(room)).all()


def test_nothing_reaches_through_the_ceiling_and_lamps_hang_from_it(prior):
    rooms = prior.sample(4, seed=0, floor="4x4", ceiling_m=2.2, want={"ceiling_lamp": 1})
    for room in rooms:
        tops = room.centers_m[:, 1] + room.sizes_m[:, 1] / 2
        assert room.ceiling_m == 2.2 and tops.max() <= 2.211
        assert tops[labels(room).index("ceiling_lamp")] == pytest.approx(2.2, abs=1e-4)


def test_where_floor_is_scarce_beds_stand_on_it_and_keep_their_size(prior):
    want = {"double_bed": 1, "single_bed": 1, "desk": 2, "sofa": 1}
    for room in prior.sample(2, seed=0, floor="3.2x3", openings="door", want=want):
        for item in room.objects:
            if "bed" in item.label:
                assert item.center_m[1] - item.size_m[1] / 2 <= 0.151
                assert item.size_m[0] * item.size_m[2] > 1.1  # m2

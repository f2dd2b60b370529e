"""Wishes and whole requests: what is read."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneprior.core.scene import SceneObject
from sceneprior.lifted.requests.openings import WantedOpening
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.lifted.requests.wishes import (
    RelationWish,
    Wishes,
    check_wishes,
    count_wish,
    counts_of_text,
    read_wishes,
)

KNOWN = ["bed", "nightstand", "desk"]
LABELS = "void,bed,nightstand,desk,sofa"


@pytest.mark.parametrize(
    ("value", "bounds"),
    [(2, (2, 2)), ("2", (2, 2)), ("=2", (2, 2)), (">=1", (1, None)), ("<= 3", (0, 3)), (0, (0, 0))],
)
def test_numbers_are_exact_least_or_largest(value, bounds):
    wish = count_wish("desk", value)
    assert (wish.least, wish.most) == bounds
    assert [wish.holds(count) for count in range(5)] == [
        bounds[0] <= count <= (bounds[1] if bounds[1] is not None else 9) for count in range(5)
    ]


def test_relations_need_their_objects():
    wishes = Wishes((), (RelationWish("nightstand", "beside", "bed", 2),))
    assert wishes.bounds("nightstand") == (2, None) and wishes.bounds("bed") == (1, None)
    assert Wishes((), (RelationWish("desk", "near", "desk"),)).bounds("desk") == (2, None)
    assert Wishes((), (RelationWish("desk", "near", "window"),)).labels == ["desk"]


def test_wishes_that_fit_pass():
    check_wishes(read_wishes({"bed": 1, "desk": "<=2"}), KNOWN, {"bed": 1, "piano": 1}, 5)


def test_a_floor_is_moved_to_its_middle_unless_objects_stand_on_it():
    asked = {"floor": [[0, 0], [4, 0], [4, 2], [0, 2]]}
    there = RoomRequest(**asked).conditions(KNOWN, LABELS, 9).floor
    assert there is not None
    assert there.outline_m.tolist() == [[-2, -1], [2, -1], [2, 1], [-2, 1]]
    sofa = SceneObject("sofa", (1.0, 0.4, 1.0), (1.0, 0.8, 1.0))
    there = RoomRequest(**asked, objects=[sofa]).conditions(KNOWN, LABELS, 9).floor
    assert there is not None and there.outline_m.tolist() == asked["floor"]


def test_counts_as_text_are_those_of_a_mapping():
    assert counts_of_text(" double_bed: 1; desk:0, stool : >=2") == {
        "double_bed": "1", "desk": "0", "stool": ">=2",
    }  # fmt: skip
    for other in ("a bed", "two beds: 1", "bed: 1,", "bed 1", ""):
        assert counts_of_text(other) is None


def test_a_relation_to_a_window_adds_the_window():
    want = {"relations": [{"subject": "desk", "relation": "under", "target": "window"}]}
    (window,) = RoomRequest(want=want).conditions(KNOWN, LABELS, 9).openings
    assert window == WantedOpening("window")


@given(
    st.dictionaries(st.sampled_from(KNOWN), st.integers(0, 9) | st.just(">=1"), max_size=3),
    st.lists(st.sampled_from(["door", "window@north", "door@2:1.5"]), max_size=3),
    st.none() | st.floats(1, 20),
)
def test_the_parts_of_a_request_make_the_same_request(want, openings, ceiling_m):
    request = RoomRequest.of(want=want, openings=openings, ceiling_m=ceiling_m, floor="4x3")
    again = RoomRequest.of(**request.parts())
    assert again.parts() == request.parts() and again.wishes == request.wishes

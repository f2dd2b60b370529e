"""Wishes and whole requests: what is read."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening, SceneObject
from sceneprior.lifted.requests.openings import WantedOpening
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.lifted.requests.wishes import (
    RelationWish,
    Wishes,
    read_wishes,
)

KNOWN = ["bed", "nightstand", "desk"]
LABELS = "void,bed,nightstand,desk,sofa"


def test_relations_need_their_objects():
    wishes = Wishes((), (RelationWish("nightstand", "beside", "bed", 2),))
    assert wishes.bounds["nightstand"] == (2, math.inf) and wishes.bounds["bed"] == (1, math.inf)
    assert Wishes((), (RelationWish("desk", "near", "desk"),)).bounds["desk"] == (2, math.inf)
    assert Wishes((), (RelationWish("desk", "near", "window"),)).bounds["window"] == (1, math.inf)


def test_a_floor_is_moved_to_its_middle_unless_objects_stand_on_it():
    door = Opening("door", (1.0, 0.0), (2.0, 0.0), 0.0, 2.0)
    asked = {"floor": [[0, 0], [4, 0], [4, 2], [0, 2]], "openings": [door, "window"]}
    moved = RoomRequest(**asked).conditions(KNOWN, LABELS, 9)
    assert moved.floor is not None
    assert moved.floor.outline_m.tolist() == [[-2, -1], [2, -1], [2, 1], [-2, 1]]
    there = door._replace(start_m=(-1.0, -1.0), end_m=(0.0, -1.0))
    assert moved.openings == (there, WantedOpening("window"))
    sofa = SceneObject("sofa", (1.0, 0.4, 1.0), (1.0, 0.8, 1.0))
    stays = RoomRequest(**asked, objects=[sofa]).conditions(KNOWN, LABELS, 9)
    assert stays.floor is not None and stays.floor.outline_m.tolist() == asked["floor"]
    assert stays.openings[0] == door


def test_counts_as_text_are_those_of_a_mapping():
    found = read_wishes(" double_bed: 1; desk:0, stool : >=2")
    assert found == read_wishes({"double_bed": 1, "desk": "0", "stool": ">=2"})
    for other in ("a bed", "two beds: 1", "bed: 1,", "bed 1", ""):
        assert read_wishes(other) is None


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


def test_chairs_are_dealt_out_to_tables_and_no_chair_is_wished_at_two():
    found = read_wishes({"chair": 4, "table": 1, "desk": 1}).implied
    assert {(str(wish.target), wish.count) for wish in found if wish.relation == "at"} == {
        ("desk", 1), ("table", 3),
    }  # fmt: skip
    found = read_wishes({"chair": 1, "table": 1, "desk": 1}).implied
    assert [wish.target for wish in found if wish.relation == "at"] == ["desk"]


@pytest.mark.parametrize(("kind", "high"), [("door", 2.0), ("window", 2.1)])
def test_drawn_doors_and_windows_are_below_the_ceiling(kind, high):
    asked = RoomRequest(floor="4x3", openings=kind, ceiling_m=high - 0.2)
    with pytest.raises(InputError, match=f"a {kind}, which is {high:g} m high"):
        asked.conditions(KNOWN, LABELS, 9)
    RoomRequest(floor="4x3", openings=kind, ceiling_m=high + 0.2).conditions(KNOWN, LABELS, 9)

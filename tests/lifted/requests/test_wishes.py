"""Wishes: what is read, and what contradicts itself."""

import pytest

from sceneprior.core.errors import InputError
from sceneprior.lifted.requests.request import make_request, read_wishes
from sceneprior.lifted.requests.wishes import (
    RelationWish,
    Wishes,
    check_wishes,
    count_wish,
    counts_of_text,
    relation_wish,
)

KNOWN = ["bed", "nightstand", "desk"]


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


@pytest.mark.parametrize("value", ["many", -1, 1.5, True, None, [2]])
def test_other_numbers_are_a_sentence(value):
    with pytest.raises(InputError, match=r"The wish for desk is .*; expected a number of objects"):
        count_wish("desk", value)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"subject": "desk"}, "expected subject and relation"),
        ({"subject": "desk", "relation": "on"}, "No relation is called 'on'; choose from beside"),
        ({"subject": "desk", "relation": "near"}, "'near' needs a target"),
        ({"subject": "desk", "relation": "at a wall", "target": "bed"}, "takes no target"),
        ({"subject": "desk", "relation": "at a wall", "count": 0}, "count 0; expected a whole"),
    ],
)
def test_other_relations_are_a_sentence(entry, message):
    with pytest.raises(InputError, match=message):
        relation_wish(entry)


def test_relations_need_their_objects():
    wishes = Wishes((), (RelationWish("nightstand", "beside", "bed", 2),))
    assert wishes.bounds("nightstand") == (2, None) and wishes.bounds("bed") == (1, None)
    assert Wishes((), (RelationWish("desk", "near", "desk"),)).bounds("desk") == (2, None)
    assert Wishes((), (RelationWish("desk", "near", "window"),)).labels == ["desk"]


@pytest.mark.parametrize(
    ("want", "given", "message"),
    [
        ({"piano": 1}, {}, "'piano' is not a class of this run's training rooms; choose from bed"),
        ({"bed": 6}, {}, "need 6 objects, but rooms of this run hold at most 5"),
        ({"bed": 1}, {"bed": 2}, "given with 2 bed, and the wishes allow 1"),
        (
            {"bed": 0, "relations": [{"subject": "desk", "relation": "near", "target": "bed"}]},
            {}, "need 1 bed and allow 0",
        ),
    ],
)  # fmt: skip
def test_wishes_that_no_room_meets_are_a_sentence(want, given, message):
    with pytest.raises(InputError, match=message):
        check_wishes(read_wishes(want), KNOWN, given, 5)


def test_wishes_that_fit_pass():
    check_wishes(read_wishes({"bed": 1, "desk": "<=2"}), KNOWN, {"bed": 1, "piano": 1}, 5)


@pytest.mark.parametrize("height", [0.2, 250.0])
def test_ceilings_are_of_rooms(height):
    with pytest.raises(InputError, match="expected 1 to 20 m above the floor"):
        make_request(KNOWN, "toy", ceiling_m=height)


def test_a_floor_is_moved_to_its_middle_unless_objects_stand_on_it():
    floor = [[0, 0], [4, 0], [4, 2], [0, 2]]
    outline = make_request(KNOWN, "toy", floor).outline_m
    assert outline is not None and outline.tolist() == [[-2, -1], [2, -1], [2, 1], [-2, 1]]


def test_counts_as_text_are_those_of_a_mapping():
    assert counts_of_text(" double_bed: 1; desk:0, stool : >=2") == {
        "double_bed": "1", "desk": "0", "stool": ">=2",
    }  # fmt: skip
    for other in ("a bed", "two beds: 1", "bed: 1,", "bed 1", ""):
        assert counts_of_text(other) is None
    with pytest.raises(InputError, match="wish for bed is '-1'; expected a number of objects"):
        make_request(KNOWN, "toy", want="bed: -1")
    with pytest.raises(InputError, match="list bed twice"):
        counts_of_text("bed: 1, bed: 2")

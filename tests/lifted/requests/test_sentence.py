"""Sentences: what they ask for."""

import pytest

from sceneprior.lifted.requests.sentence import read_sentence

KNOWN = [
    "armchair", "bookshelf", "cabinet", "ceiling_lamp", "chair", "coffee_table", "desk",
    "double_bed", "nightstand", "sofa", "tv_stand", "table",
]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "floor", "openings", "counts", "relations"),
    [
        ("a 4 x 3 m bedroom with a door, two nightstands", "4x3", ["door"],
         ["1 door", "2 nightstand"], []),
        (
            "A double bed and two nightstands beside it, a desk under the window, no sofa.",
            None, [], ["1 double_bed", "2 nightstand", "1 desk", "0 sofa"],
            ["2 nightstand beside double_bed", "desk under window"],
        ),
        (
            "I want a bed against the wall, at least two chairs near the desk; the sofa faces the "
            "TV stand",
            None, [],
            ["1 double_bed", "at least 2 chair", "at least 1 desk", "at least 1 sofa",
             "at least 1 tv_stand"],
            ["double_bed at a wall", "2 chair near desk", "sofa facing tv_stand"],
        ),
        (
            "bookshelves and some chairs, 3.5m by 4 metres, a door in the south wall and 2 windows",
            "3.5x4", ["door@south", "window", "window"],
            ["at least 2 bookshelf", "at least 1 chair", "1 door", "2 window"], [],
        ),
        (
            "two chairs at the table and a chair in the corner", None, [],
            ["3 chair", "at least 1 table"], ["2 chair near table", "chair in a corner"],
        ),
        ("at most 2 dining chairs in the room", None, [], ["at most 2 chair"], []),
        ("a night-stand next to the bed far from the door", None, [],
         ["1 nightstand", "at least 1 double_bed"],
         ["nightstand beside double_bed", "nightstand far from door"]),
        ("without a sofa", None, [], ["0 sofa"], []),
        ("a door, the two chairs far from the door in the north wall", None, ["door@north"],
         ["1 door", "2 chair"], ["2 chair far from door"]),
    ],
)  # fmt: skip
def test_sentences(text, floor, openings, counts, relations):
    found = read_sentence(text, KNOWN, "front3d_bedroom")
    assert found.floor == floor and found.openings == openings
    assert sorted(map(str, found.wishes.counts)) == sorted(counts)
    assert list(map(str, found.wishes.relations)) == relations

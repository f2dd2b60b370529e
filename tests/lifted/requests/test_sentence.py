"""Sentences: what they ask for, and words that are refused."""

import pytest

from sceneprior.core.errors import InputError
from sceneprior.lifted.requests.sentence import read_sentence

KNOWN = [
    "armchair", "bookshelf", "cabinet", "ceiling_lamp", "chair", "coffee_table", "desk",
    "double_bed", "nightstand", "sofa", "tv_stand", "table",
]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "floor", "openings", "counts", "relations"),
    [
        ("a 4 x 3 m bedroom with a door, two nightstands", "4x3", ["door"], ["2 nightstand"], []),
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
            ["at least 2 bookshelf", "at least 1 chair"], [],
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
    ],
)  # fmt: skip
def test_sentences(text, floor, openings, counts, relations):
    found = read_sentence(text, KNOWN, "front3d_bedroom")
    assert found.floor == floor and found.openings == openings
    assert sorted(map(str, found.wishes.counts)) == sorted(counts)
    assert list(map(str, found.wishes.relations)) == relations


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a purple bed", "'purple'"),
        ("a bed on the moon", "'on', 'moon'"),
        ("a nightstand on each side of the bed", "'on', 'each', 'side', 'of'"),
        ("beside the bed", "'beside'"),
        ("a bed beside", "'beside'"),
        ("a bed in the wardrobe", "'in', 'wardrobe'"),
        ("a bed beside the wardrobe", "'wardrobe'"),
        ("two bedrooms", "'bedrooms'"),
        ("a bed and at least three pianos and 4 organs", "'pianos', 'organs'"),
        ("a bed # 3", "'\\?'"),
    ],
)
def test_what_is_not_understood_is_said(text, words):
    with pytest.raises(InputError, match=f"words that are not understood: {words}\\. It may name"):
        read_sentence(text, KNOWN, "front3d_bedroom")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a living room", "for a living room, but this prior draws rooms of 'front3d_bedroom'"),
        ("3x4 or 4x5", "names 2 sizes of floors"),
        ("a 180 m bed", r"has a length \(180 m\), but only the floor can have a size"),
        ("a bed of 180 x 200 cm", r"has a length \(200 cm\)"),
        ("a 4x3 room with a 1.4 m desk", r"has a length \(1\.4 m\)"),
        ("a 1.8 x 2 m bed", r"has a length \(of the double bed\)"),
        ("a bed " * 400, "has 2400 characters; expected at most 2000"),
    ],
)
def test_other_sentences_are_refused(text, message):
    with pytest.raises(InputError, match=message):
        read_sentence(text, KNOWN, "front3d_bedroom")


def test_a_piece_that_the_prior_does_not_know_keeps_its_name():
    (wish,) = read_sentence("a fridge", KNOWN, "front3d_bedroom").wishes.counts
    assert str(wish) == "1 refridgerator"

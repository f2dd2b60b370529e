"""Sentences: what they ask for."""

from itertools import product

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
        ("a 4 x 3 m bedroom with a door, two nightstands", "4x3", ["door"],
         ["1 door", "2 nightstand"], []),
        (
            "A double bed and two nightstands beside it, a desk under the window, no sofa.",
            None, [], ["1 double_bed", "2 nightstand", "1 desk", "0 sofa"],
            ["2 nightstand on both sides of double_bed", "desk under window"],
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
            ["3 chair", "at least 1 table"], ["2 chair at table", "chair in a corner"],
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


SIDES = [
    f"{word} {sides}"
    for word in ("on", "at", "to")
    for sides in ("each side", "either side", "both sides", "its two sides")
]
PAIRS = ("a nightstand", "two nightstands", "nightstands", "a pair of bedside tables",
         "one nightstand", "two nightstands, one")  # fmt: skip
OF_BED = ("of the bed", "of it", "of the headboard", "of the bed's head", "of the head of the bed")
HEADS = ("the headboard", "its head", "the head end", "the headboard side", "the bed's headboard",
         "the head of the bed", "its headboard")  # fmt: skip
FEET = ("the foot of the bed", "its foot", "the bed's foot", "the footboard", "the end of the bed")
BY = ("at", "by", "near", "beside", "next to", "on", "against")


def relations(*words: str) -> list[str]:
    """The relations of a sentence that starts with a bed."""
    found = read_sentence(f"a double bed with {' '.join(words)} and a desk", KNOWN, "void,own")
    least = {label: bounds[0] for label, bounds in found.wishes.bounds.items()}
    for wish in found.wishes.relations:
        assert least[wish.subject] >= wish.count
    return list(map(str, found.wishes.relations))


@pytest.mark.parametrize("pair", PAIRS)
def test_two_nightstands_by_a_bed_are_one_on_each_side(pair):
    both = ["2 nightstand on both sides of double_bed"]
    for sides, of in product(SIDES, (*OF_BED, "")):
        assert relations(pair, sides, of) == both
    for words in ("flanking the bed", "that flank it", "framing the headboard"):
        assert relations(pair, words) == both
    if "two" in pair and "one" not in pair:
        for by, head in product(BY, HEADS):
            assert relations(pair, by, head) == both
        for words in ("beside it", "next to the bed", "at the bed, beside the bed"):
            assert relations(pair, words)[-1:] == both


@pytest.mark.parametrize("by", BY)
def test_a_piece_at_an_end_of_the_bed(by):
    for head in HEADS:
        assert relations("a nightstand", by, head) == ["nightstand beside double_bed"]
    for foot in FEET:
        assert relations("a chair", by, foot) == ["chair at the foot of double_bed"]


@pytest.mark.parametrize("words", ["flanked by", "between", "framed by"])
def test_a_bed_between_two_nightstands(words):
    for pair in ("two nightstands", "nightstands", "a pair of night tables"):
        found = read_sentence(f"a bed {words} {pair}, at a wall", KNOWN, "void,own").wishes
        assert list(map(str, found.relations)) == [
            "2 nightstand on both sides of double_bed", "double_bed at a wall"
        ]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "asked"),
    [
        ("a chair on each side of the table", "2 chair on both sides of table"),
        ("two chairs on each side of the table", "4 chair on both sides of table"),
        ("two chairs on either side of the table", "2 chair on both sides of table"),
        ("four chairs around the table", "4 chair at table"),
        ("a chair at the desk", "chair at desk"),
        ("a chair at the bed", "chair near double_bed"),
        ("a tv stand opposite the bed", "tv_stand opposite double_bed"),
        ("a tv stand facing the foot of the bed", "tv_stand facing double_bed"),
        ("a desk up against the window", "desk against window"),
        *((f"a cabinet with its back {by} {wall} wall", "cabinet back to a wall")
          for by in ("to", "against") for wall in ("a", "the", "one")),
        *((f"a cabinet {by} {wall} wall", "cabinet at a wall")
          for by in ("at", "against", "along", "by", "on") for wall in ("a", "the", "one")),
    ],
)  # fmt: skip
def test_other_relations(words, asked):
    assert relations(words) == [asked]


@pytest.mark.parametrize("words", [
    "a nightstand on each side of the foot of the bed", "a lamp on the desk",
    "a desk between the bed and a table", "one on each side", "a cabinet flanked by a chair",
])  # fmt: skip
def test_what_has_no_meaning_is_refused(words):
    with pytest.raises(InputError, match="not understood"):
        read_sentence(words, [*KNOWN, "pendant_lamp"], "void,own")

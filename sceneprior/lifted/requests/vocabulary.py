"""Words of requests in English, and the phrases of a sentence."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from sceneprior.core.classes import LABEL_SETS
from sceneprior.lifted.requests.wishes import OPENINGS, count_of

NOUNS: dict[str, tuple[str, ...]] = {
    "bed": ("double_bed", "single_bed", "kids_bed", "bed"),
    "double bed": ("double_bed", "bed"), "queen bed": ("double_bed",), "king bed": ("double_bed",),
    "single bed": ("single_bed", "bed"), "twin bed": ("single_bed",),
    "kids bed": ("kids_bed",), "children bed": ("kids_bed",), "bunk bed": ("kids_bed",),
    "bedside table": ("nightstand", "night stand"), "bed side table": ("nightstand", "night stand"),
    "night table": ("nightstand", "night stand"),
    "nightstand": ("nightstand", "night stand"), "night stand": ("nightstand", "night stand"),
    "closet": ("wardrobe",), "armoire": ("wardrobe",), "couch": ("sofa",), "settee": ("sofa",),
    "sofa": ("sofa",), "lounge chair": ("armchair",), "easy chair": ("armchair",),
    "dining chair": ("chair",), "office chair": ("chair",), "desk chair": ("chair",),
    "dining table": ("table",), "side table": ("table",), "writing desk": ("desk",),
    "vanity": ("dressing_table", "dresser"), "bookcase": ("bookshelf",), "cupboard": ("cabinet",),
    "chest of drawers": ("cabinet", "dresser"), "dresser": ("dresser", "cabinet"),
    "sideboard": ("cabinet",), "tv cabinet": ("tv_stand",), "tv bench": ("tv_stand",),
    "tv unit": ("tv_stand",), "television stand": ("tv_stand",), "hanging lamp": ("pendant_lamp",),
    "chandelier": ("pendant_lamp", "ceiling_lamp"), "ceiling light": ("ceiling_lamp",),
    "lamp": ("ceiling_lamp", "pendant_lamp", "lamp"), "fridge": ("refridgerator",),
    "refrigerator": ("refridgerator",), "tv": ("television",), "tub": ("bathtub",),
}  # fmt: skip
"""Classes that a noun may mean; the first class that the prior draws is used."""
_SIDES = [
    f"{word} {sides}"
    for sides in ("each side", "either side", "both sides", "its two sides", "the two sides",
                  "its sides", "opposite sides")
    for word in ("on", "at", "to")
]  # fmt: skip
RELATION_WORDS = {
    "beside": "beside", "next to": "beside", "alongside": "beside", "adjacent to": "beside",
    "at the side of": "beside", "on one side of": "beside", "to one side of": "beside",
    **{f"{words} of": "on both sides of" for words in _SIDES},
    **{f"{end}{word}": "on both sides of"
       for word in ("flanking", "flank", "framing") for end in ("", "that ", "which ")},
    "in front of": "in front of", "before": "in front of", "facing": "facing",
    "that faces": "facing", "which faces": "facing", "that face": "facing", "face": "facing",
    "faces": "facing", "looking at": "facing", "turned to": "facing", "turned towards": "facing",
    "opposite": "opposite", "opposite to": "opposite", "opposite of": "opposite",
    "across from": "opposite", "at": "at", "around": "at", "against": "against",
    "up against": "against", "touching": "against", "under": "under",
    "below": "under", "beneath": "under", "underneath": "under", "near": "near", "near to": "near",
    "close to": "near", "by": "near", "far from": "far from", "far away from": "far from",
    "away from": "far from", "on": "on", "to": "on",
}  # fmt: skip
"""Relations to an object, a door or a window; `on` is one only with an end of a bed."""
RELATIONS_TO_IT = dict.fromkeys(_SIDES, "on both sides of")
"""Relations to the object named before."""
INVERTED_WORDS = {"flanked by": "on both sides of", "framed by": "on both sides of",
                  "between": "on both sides of"}  # fmt: skip
"""Relations of the objects that follow to the object before: "a bed between two nightstands"."""
ENDS = {
    **dict.fromkeys(("head", "headboard", "head end", "head side", "headboard end",
                     "headboard side", "bedhead"), "head"),
    **dict.fromkeys(("foot", "footboard", "foot end", "foot side", "footboard end", "end"), "foot"),
}  # fmt: skip
"""Words for the two ends of a bed."""
ROOM_WORDS = (
    {
        f"{word} {article}{noun}": relation
        for noun, relation, words in (
            ("wall", "at a wall", ("at", "against", "along", "on", "by", "to", "up against")),
            ("walls", "at a wall", ("at", "against", "along", "on", "by")),
            ("corner", "in a corner", ("in", "at")),
        )
        for word in words
        for article in ("a ", "the ", "one ", "")
    }
    | {
        f"{start}{side}{end} {word} {article} wall": "back to a wall"
        for start in ("with its ", "with the ", "with their ", "its ", "their ", "")
        for side in ("back", "head", "headboard")
        for end in ("", "s")
        for word in ("to", "against", "at", "on", "along")
        for article in ("a", "the", "one")
    }
    | {words: words for words in ("with a free front",)}
)
"""Relations to the room."""
NUMBERS = {
    "no": 0, "zero": 0, "without": 0, "a": 1, "an": 1, "one": 1, "another": 1, "two": 2, "three": 3,
    "four": 4, "five": 5, "six": 6, "seven": 7, "eight": 8, "nine": 9, "ten": 10, "eleven": 11,
    "twelve": 12, "a pair of": 2, "a couple of": 2,
}  # fmt: skip
BOUNDS = {"at least": ">=", "at most": "<=", "no more than": "<=", "no fewer than": ">=",
          "up to": "<=", "exactly": ""}  # fmt: skip
WALL_WORDS = {
    f"{word} the {wall}{end}": wall
    for word in ("in", "on", "to", "at")
    for wall in ("north", "east", "south", "west")
    for end in (" wall", "")
}
"""Walls of doors and windows."""
ROOMS = {
    "bedroom": ("bedroom", "all"), "living room": ("living", "all"),
    "dining room": ("dining", "all"), "library": ("library", "all"),
    "kitchen": ("kitchen", "all"), "room": (),
}  # fmt: skip
"""Room types, each with the endings of the label sets that contain it; `room` matches any."""
FILLERS = (
    "and", "with", ",", ";", ".", ":", "but", "also", "then", "please", "i", "we", "want", "would",
    "like", "need", "give", "me", "us", "make", "draw", "is", "are", "be", "stands", "stand",
    "standing", "placed", "put", "that", "which", "there", "has", "have", "having", "containing",
    "should",
)  # fmt: skip
"""Words that are skipped."""
SIZE_TOKEN = "#"
"""Token for the size of the floor, so that it is not mistaken for the size of furniture."""


class Token(NamedTuple):
    """A phrase of the vocabulary, or an unknown word."""

    text: str
    kind: str = "unknown"
    value: Any = None


def meanings_of(known: Sequence[str]) -> dict[str, tuple[str, Any]]:
    """The kind and the value of each phrase; later entries override earlier ones."""
    nouns: dict[str, tuple[str, ...]] = {}
    nouns |= {
        name.replace("_", " "): (name,) for names in LABEL_SETS.values() for name in names[1:]
    }
    nouns |= {noun: classes for noun, classes in NOUNS.items() if noun not in known}
    nouns |= {name.replace("_", " "): (name,) for name in known}
    nouns |= {opening: (opening,) for opening in OPENINGS}
    labels = {
        noun: next((name for name in classes if name in known), classes[0])
        for noun, classes in nouns.items()
    }
    plurals = {
        plural: label
        for noun, label in labels.items()
        for plural in (f"{noun}s", f"{noun[:-1]}ves" if noun.endswith("f") else f"{noun}es")
    }
    return (
        {word: ("filler", None) for word in (*FILLERS, SIZE_TOKEN)}
        | {word: ("before a room", None) for word in ("in", "for", "of")}
        | {word: ("pronoun", None) for word in ("it", "them")}
        | {"the": ("the", None), "some": ("some", None), "any": ("some", None)}
        | {"its": ("possessive", None), "their": ("possessive", None), "'s": ("'s", None)}
        | {noun: ("noun", (True, label)) for noun, label in plurals.items()}
        | {noun: ("noun", (False, label)) for noun, label in labels.items()}
        | {room: ("room", ends) for room, ends in ROOMS.items()}
        | {word: ("number", number) for word, number in NUMBERS.items()}
        | {word: ("bound", sign) for word, sign in BOUNDS.items()}
        | {word: ("relation", relation) for word, relation in RELATION_WORDS.items()}
        | {word: ("relation to it", relation) for word, relation in RELATIONS_TO_IT.items()}
        | {word: ("inverted relation", relation) for word, relation in INVERTED_WORDS.items()}
        | {word: ("relation to the room", relation) for word, relation in ROOM_WORDS.items()}
        | {word: ("end of a bed", end) for word, end in ENDS.items()}
        | {word: ("wall", wall) for word, wall in WALL_WORDS.items()}
    )


def lex(words: list[str], meanings: dict[str, tuple[str, Any]]) -> list[Token]:
    """Split words into the longest phrases of the vocabulary, from left to right."""
    longest = max(len(phrase.split()) for phrase in meanings)
    tokens: list[Token] = []
    while words:
        for length in range(min(longest, len(words)), 0, -1):
            if (phrase := " ".join(words[:length])) in meanings:
                break
        if phrase.isdecimal():
            tokens.append(Token(phrase, "number", count_of(phrase)))
        else:
            tokens.append(Token(phrase, *meanings.get(phrase, ())))
        words = words[length:]
    return tokens

"""Parser of requests in English: a small grammar over class names, numbers and relations.

A sentence is a list of phrases `[number] noun [relation noun]...`. In place of a noun, it may have
the size of the floor or a room type. Unknown words are an error, so that no wish is dropped.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from sceneprior.core.arrangements import BEDS, CHAIRS, TABLES
from sceneprior.core.errors import InputError
from sceneprior.lifted.requests.vocabulary import (
    BOUNDS,
    NUMBERS,
    RELATION_WORDS,
    SIZE_TOKEN,
    Token,
    lex,
    meanings_of,
)
from sceneprior.lifted.requests.wishes import (
    OPENINGS,
    CountWish,
    RelationWish,
    Wishes,
    meant_relation,
)  # fmt: skip

LONGEST = 2000
"""Maximum number of characters of a sentence."""
_UNIT = r"\s*(?:m|metres?|meters?)?"
_SIZE = re.compile(rf"(\d+\.?\d*){_UNIT}\s*(?:x|×|by)\s*(\d+\.?\d*){_UNIT}\b(?!\s*[cm]m\b)")
_LENGTH = re.compile(r"\d+\.?\d*\s*(?:mm|cm|m|metres?|meters?|centimetres?|centimeters?)\b")
_NEGATIVE = re.compile(r"(?:(?<!\w)|(?<=[^-−][x×]))[-−]\d[\w.]{0,9}")
_TOKEN = re.compile(r"[a-z_']+|\d+(?:\.\d+)?|\S")


class Sentence(NamedTuple):
    """The content of a sentence: wishes, floor and openings."""

    wishes: Wishes
    floor: str | None
    """Size such as `4x3`."""
    openings: list[str]
    """Doors and windows in the form that `read_openings` reads."""


def read_sentence(text: str, known: Sequence[str], label_set: str) -> Sentence:
    """Parse the wishes, the size of the floor, and the doors and windows of a sentence.

    Args:
        text: Such as "a 4 x 3 m bedroom with a door and two nightstands beside the bed".
        known: Classes that the prior draws.
        label_set: Name of the prior's label set, which ends with the room type.

    Raises:
        InputError: there are unknown words, which the message lists, or lengths other than the
            floor's.
    """
    if len(text) > LONGEST:
        raise InputError(f"The request has {len(text)} characters; expected at most {LONGEST}.")
    if (negative := _NEGATIVE.search(text.lower())) is not None:
        raise InputError(
            f"The request has a number below 0 ('{negative[0]}'); numbers and sizes are above 0."
        )
    lowered = re.sub("['’]s\\b", " 's", text.lower().replace("-", " "))
    sizes = _SIZE.findall(lowered)
    if len(sizes) > 1:
        raise InputError(f"The request names {len(sizes)} sizes of floors; expected one.")
    rest = _SIZE.sub(f" {SIZE_TOKEN} ", lowered.replace(SIZE_TOKEN, "?"))
    if (length := _LENGTH.search(rest)) is not None:
        raise _other_length(length[0])
    meanings = meanings_of(known)
    reader = _Reader(lex(_TOKEN.findall(rest), meanings), label_set, meanings["bed"][1][1])
    if reader.strange:
        # If another word is unknown, words before a noun are left out: usually it is their noun.
        fine = {"a", "an", "the", *RELATION_WORDS, *NUMBERS, *" ".join(BOUNDS).split()}
        listed = [
            word for word in reader.strange if not (word in fine or word.isdecimal())
        ] or reader.strange
        words = ", ".join(f"'{word[:40]}'" for word in dict.fromkeys(listed))
        raise InputError(
            f"The request has words that are not understood: {words}. It may name numbers, doors, "
            f"windows, the classes {', '.join(name.replace('_', ' ') for name in known)}, and "
            "relations such as beside, on each side of, at the foot of, in front of, facing, "
            "opposite, against a wall, in a corner, under, near and far from; leave out the rest."
        )
    floor = "x".join(sizes[0]) if sizes else None
    return Sentence(reader.wishes(), floor, reader.openings)


def _other_length(length: str) -> InputError:
    return InputError(
        f"The request has a length ({length}), but only the floor can have a size, in metres, such "
        "as 'a 4 x 3 m bedroom'; leave the length out."
    )


@dataclass
class _Group:
    """The objects of one phrase."""

    noun: str
    number: int
    sign: str
    """`>=`, `<=`, or empty for exactly."""
    new: bool
    """False for "the bed", which refers to an object mentioned elsewhere."""
    counted: bool
    """True if it has a number of its own."""
    said: str


class _Reader:
    """Reads tokens from left to right; `strange` collects words without a meaning where they
    stand. `bed` is the class that "bed" means."""

    def __init__(self, tokens: list[Token], label_set: str, bed: str):
        self.tokens, self.label_set, self.bed = [*tokens, Token("", "end")], label_set, bed
        self.strange: list[str] = []
        self.openings: list[str] = []
        self.groups: list[_Group] = []
        self.relations: list[RelationWish] = []
        self.subject: _Group | None = None
        self.at = 0
        while self.tokens[self.at].kind != "end":
            start = self.at
            if self._relation() or self._group() is not None or self.at > start:
                continue
            token = self.tokens[self.at]
            self.at += 1
            if token.kind != "filler" and not (token.kind == "before a room" and self._in_room()):
                self.strange += token.text.split()

    def wishes(self) -> Wishes:
        """The counts of all groups of the sentence, summed by class, and the relations between
        them."""
        bare, exact = [group for group in self.groups if not group.sign], dict[str, list[_Group]]()
        for group in bare:
            if group.new and group.number:
                exact.setdefault(group.noun, []).append(group)
        counts = [
            CountWish(group.noun, 0, group.number, group.said)
            if group.sign == "<="
            else CountWish(group.noun, group.number, None, group.said)
            for group in self.groups
            if group.sign
        ]
        for noun, own in exact.items():
            total, said = sum(group.number for group in own), " and ".join(g.said for g in own)
            counts.append(CountWish(noun, total, total, said))
        # "A bed and no bed" is no sum.
        counts += [CountWish(group.noun, 0, 0, group.said) for group in bare if not group.number]
        implied = {wish.target for wish in self.relations}.intersection(OPENINGS)
        for group in bare:
            if group.new or not group.number or (group.number == 1 and group.noun in implied):
                continue
            # "The two beds" are all beds, unless beds are named elsewhere.
            most = group.number if group.counted and group.noun not in exact else None
            others = [wish.least for wish in counts if wish.label == group.noun]
            if most or group.number > max(others, default=0):
                counts.append(CountWish(group.noun, group.number, most, group.said))
        return Wishes(tuple(counts), tuple(self.relations))

    def _next(self, *kinds: str) -> Token | None:
        """Read the next token if it is of one of these kinds."""
        token = self.tokens[self.at]
        if token.kind not in kinds:
            return None
        self.at += 1
        return token

    def _in_room(self) -> bool:
        """Read a room type after "in", as in "two chairs in the room"."""
        start = self.at
        self.at += self.tokens[start].text in ("a", "an", "the", "one", "my")
        found = self._room(None, None)
        self.at = self.at if found else start
        return found

    def _relation(self) -> bool:
        """Read a relation of the last group, if one comes next."""
        # "Two nightstands, one on each side" are two.
        self.at += self.tokens[self.at].text in ("one", "each") and self._is_to_sides(self.at + 1)
        subject, start = self.subject, self.at
        token = self._next(
            "relation", "relation to it", "inverted relation", "relation to the room"
        )
        if token is None:
            return False
        relation, target = token.value, None
        if token.kind == "relation":
            relation, target = self._end_and_target(relation)
        elif token.kind == "relation to it":
            target = self._named_before()
        elif token.kind == "inverted relation":
            target, others = subject.noun if subject else None, self._group()
            self.subject = subject
            subject = others if others is not None and others.number > 1 else None
        to_room = token.kind == "relation to the room"
        if subject is None or (not to_room and (target is None or subject.noun in OPENINGS)):
            self.strange.append(token.text)
            return True
        if token.kind != "inverted relation":
            self.subject = subject
        if relation == "on both sides of" and subject.number:
            twice = subject.counted and "each" in token.text and target not in BEDS
            subject.number = max(2, subject.number * (2 if twice else 1))
            subject.said += "".join(f" {each.text}" for each in self.tokens[start : self.at])
        if relation == "at" and not (subject.noun in CHAIRS and target in TABLES):
            relation = "near"
        count = 1 if subject.sign == "<=" else max(subject.number, 1)
        self.relations.append(meant_relation(subject.noun, relation, target, count))
        return True

    def _is_to_sides(self, at: int) -> bool:
        """True if the token at this place begins a relation to both sides of an object."""
        return self.tokens[min(at, len(self.tokens) - 1)].value == "on both sides of"

    def _end_and_target(self, relation: str) -> tuple[str, str | None]:
        """Read the target of a relation, or an end of a bed: "the bed", "the head of the bed", "the
        bed's head", "its headboard"; the relation to this end, and the target."""
        target, end = None, self._end()
        if end is None:
            target = self._target()
            end = self._end() if target and self._next("'s") else None
        elif self.tokens[self.at].text == "of":
            self.at += 1
            target = self._target()
        else:
            target = self._named_before(bed=True)
        if end and relation in ("beside", "near", "at", "against", "on"):
            return "beside" if end == "head" else "at the foot of", target
        no_place = relation == "on" or (relation == "on both sides of" and end == "foot")
        return relation, None if no_place else target

    def _end(self) -> str | None:
        """Read an end of a bed: `head` or `foot`."""
        start = self.at
        self.at += self.tokens[start].text in ("the", "its", "their", "a", "one")
        if (token := self._next("end of a bed")) is None:
            self.at = start
            return None
        return str(token.value)

    def _named_before(self, bed: bool = False) -> str | None:
        """The last noun before the subject that is another one; of a bed, if asked."""
        others = [g.noun for g in self.groups if self.subject and g.noun != self.subject.noun]
        if bed:
            others = [noun for noun in others if noun in BEDS] or [self.bed]
        return others[-1] if others else None

    def _target(self) -> str | None:
        """Read the target of a relation: a class, `door` or `window`."""
        if self._next("pronoun") is not None:
            return self._named_before()
        group = self._group()
        return None if group is None else group.noun

    def _group(self) -> _Group | None:
        """Read a number and a noun, or a room, if they come next."""
        start = self.at
        bound = self._next("bound")
        definite = self._next("the") is not None
        counted = self._next("number")
        number = None if counted is None else int(counted.value)
        if counted is not None and counted.text == "without":
            self.at += self.tokens[self.at].text in ("a", "an", "any")
        some = number is None and self._next("some") is not None
        sized = self.tokens[self.at].text == SIZE_TOKEN
        self.at += sized
        if self._room(number, bound):
            return None
        if (token := self._next("noun")) is None:
            self.at = start
            return None
        plural, noun = token.value
        if sized:
            raise _other_length(f"of the {noun.replace('_', ' ')}")
        sign = bound.value if bound else ""
        if bound and number is None:  # "at most nightstands"
            self.strange.append(bound.text)
        if number is None:
            number = 2 if plural and not some else 1
            sign = ">=" if not definite else sign
        said = " ".join(token.text for token in self.tokens[start : self.at])
        group = _Group(noun, number, sign, not definite, counted is not None, said)
        if noun in OPENINGS:
            self._opening(group, self._next("wall"))
        self.groups.append(group)
        self.subject = group
        return group

    def _opening(self, group: _Group, wall: Token | None) -> None:
        """List the doors or windows of a group, unless it sets only an upper bound."""
        named = f"{group.noun}@{wall.value}" if wall else group.noun
        if wall and (not group.number or group.sign == "<="):
            self.strange.append(wall.text)
        elif group.new and group.sign != "<=":
            self.openings += [named] * group.number
        elif wall:  # "the two doors in the north wall"
            for _ in range(group.number - self.openings.count(named)):
                if group.noun in self.openings:
                    self.openings.remove(group.noun)
                self.openings.append(named)

    def _room(self, number: int | None, bound: Token | None) -> bool:
        """Read a room type, and refuse a type that the prior does not draw."""
        if (room := self._next("room")) is None:
            return False
        is_other = room.value and not self.label_set.endswith(room.value)
        if is_other and self.label_set.startswith("front3d_"):
            raise InputError(
                f"The request is for a {room.text}, but this prior draws rooms of "
                f"'{self.label_set}'; take another prior, or leave the room type out."
            )
        if number not in (None, 1) or bound:
            self.strange.append(room.text)
        return True

"""Parser of requests in English: a small grammar over class names, numbers and relations.

A sentence is a list of phrases `[number] noun [relation noun]...`. In place of a noun, it may have
the size of the floor or a room type. Unknown words are an error, so that no wish is dropped.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from sceneprior.core.errors import InputError
from sceneprior.lifted.requests.vocabulary import (
    ARTICLES,
    BEFORE_ROOMS,
    BOUNDS,
    FILLERS,
    NOUNS,
    NUMBERS,
    PRONOUNS,
    RELATION_WORDS,
    ROOM_WORDS,
    ROOMS,
    WALLS,
)
from sceneprior.lifted.requests.wishes import CountWish, RelationWish, Wishes

LONGEST = 2000
"""Maximum number of characters of a sentence."""
_UNIT = r"\s*(?:m|metres?|meters?)?"
_SIZE = re.compile(
    rf"(\d+\.?\d*){_UNIT}\s*(?:x|×|by)\s*(\d+\.?\d*)\s*(?:m|metres?|meters?)?\b(?!\s*[cm]m\b)"
)
_LENGTH = re.compile(r"\d+\.?\d*\s*(?:mm|cm|m|metres?|meters?|centimetres?|centimeters?)\b")
_SIZE_TOKEN = "#"
"""Token for the size of the floor, so that it is not mistaken for the size of furniture."""
_TOKEN = re.compile(r"[a-z_']+|\d+(?:\.\d+)?|\S")


@dataclass
class Sentence:
    """The content of a sentence: wishes, floor and openings."""

    wishes: Wishes
    floor: str | None = None
    """Size such as `4x3`."""
    openings: list[str] = field(default_factory=list)
    """Doors and windows in the form that `read_openings` reads."""


@dataclass
class _Group:
    """The objects of one phrase."""

    noun: str
    number: int
    bound: str
    """`>=`, `<=`, or empty for exactly."""
    new: bool
    """False for "the bed", which refers to an object mentioned elsewhere."""


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
    lowered = text.lower().replace("-", " ")
    sizes = _SIZE.findall(lowered)
    if len(sizes) > 1:
        raise InputError(f"The request names {len(sizes)} sizes of floors; expected one.")
    rest = _SIZE.sub(f" {_SIZE_TOKEN} ", lowered.replace(_SIZE_TOKEN, "?"))
    if (length := _LENGTH.search(rest)) is not None:
        raise _other_length(length[0])
    tokens = _TOKEN.findall(rest)
    reader = _Reader(tokens, known, label_set)
    reader.read()
    if reader.strange:
        # If another word is unknown, words before a noun are left out: usually it is their noun.
        fine = {*ARTICLES, *RELATION_WORDS, *NUMBERS, *" ".join(BOUNDS).split()}
        listed = [
            word for word in reader.strange if not (word in fine or word.isdecimal())
        ] or reader.strange
        words = ", ".join(f"'{word[:40]}'" for word in dict.fromkeys(listed))
        raise InputError(
            f"The request has words that are not understood: {words}. It may name numbers, doors, "
            f"windows, the classes {', '.join(name.replace('_', ' ') for name in known)}, and "
            "relations such as beside, in front of, facing, against a wall, in a corner, under, "
            "near and far from; leave out the rest."
        )
    floor = "x".join(sizes[0]) if sizes else None
    return Sentence(reader.wishes(), floor, reader.openings)


def _other_length(length: str) -> InputError:
    return InputError(
        f"The request has a length ({length}), but only the floor can have a size, in metres, such "
        "as 'a 4 x 3 m bedroom'; leave the length out."
    )


class _Reader:
    """Reads tokens from left to right; `strange` collects unknown tokens."""

    def __init__(self, tokens: list[str], known: Sequence[str], label_set: str):
        self.tokens, self.at = tokens, 0
        self.known, self.label_set = known, label_set
        self.strange: list[str] = []
        self.openings: list[str] = []
        self.groups: list[_Group] = []
        self.relations: list[RelationWish] = []
        self.nouns = {name.replace("_", " "): (name,) for name in known} | {
            noun: classes for noun, classes in NOUNS.items() if noun not in known
        }
        self.subject: _Group | None = None

    def read(self) -> None:
        """Read all tokens."""
        while self.at < len(self.tokens):
            start = self.at
            if self._relation() or self._group() is not None or self.at > start:
                continue
            word = self.tokens[self.at]
            self.at += 1
            if word in BEFORE_ROOMS and self._in_room():
                continue
            if word not in (*FILLERS, _SIZE_TOKEN):
                self.strange.append(word)

    def _in_room(self) -> bool:
        """Read a room type after "in", as in "two chairs in the room"."""
        start = self.at
        self._phrase(("a", "an", "the", "one", "my"))
        found = self._room(None, None)
        self.at = self.at if found else start
        return found

    def wishes(self) -> Wishes:
        """The counts of all groups of the sentence, summed by class, and the relations between
        them."""
        counts: list[CountWish] = []
        exact: Counter[str] = Counter()
        for group in self.groups:
            if group.noun in ("door", "window"):
                continue
            if group.bound == "<=":
                counts.append(CountWish(group.noun, 0, group.number))
            elif group.bound == ">=":
                counts.append(CountWish(group.noun, group.number))
            else:
                exact[group.noun] += group.number if group.new else 0
        named = [g.noun for g in self.groups if g.new and not g.bound]
        for noun in dict.fromkeys(named):
            if noun not in ("door", "window"):
                counts.append(CountWish(noun, exact[noun], exact[noun]))
        present = {wish.label for wish in counts}
        for group in self.groups:
            if not group.new and group.noun not in present | {"door", "window"}:
                counts.append(CountWish(group.noun, 1))
                present.add(group.noun)
        return Wishes(tuple(counts), tuple(self.relations))

    def _phrase(self, words: Sequence[str]) -> str | None:
        """Read the longest of some phrases that matches the next tokens; None if none does."""
        for phrase in sorted(words, key=lambda each: -len(each.split())):
            parts = phrase.split()
            if self.tokens[self.at : self.at + len(parts)] == parts:
                self.at += len(parts)
                return phrase
        return None

    def _relation(self) -> bool:
        """Read a relation of the last group, if one comes next."""
        start = self.at
        if (found := self._phrase(list(ROOM_WORDS))) is not None:
            if self.subject is None:
                self.strange.append(found)
            else:
                self._relate(ROOM_WORDS[found], None)
            return True
        if (
            self._phrase(list(BOUNDS)) is not None
        ):  # "at least" does not begin with the relation "at"
            self.at = start
            return False
        if (found := self._phrase(list(RELATION_WORDS))) is None:
            return False
        subject = self.subject
        target = self._target()
        if subject is None or target is None or subject.noun in ("door", "window"):
            self.strange.append(found)
            self.at = max(self.at, start + len(found.split()))
            return True
        self.subject = subject
        self._relate(RELATION_WORDS[found], target)
        return True

    def _relate(self, relation: str, target: str | None) -> None:
        assert self.subject is not None
        count = 1 if self.subject.bound == "<=" else max(self.subject.number, 1)
        self.relations.append(RelationWish(self.subject.noun, relation, target, count))

    def _target(self) -> str | None:
        """Read the target of a relation: a class, `door` or `window`."""
        if self._phrase(PRONOUNS) is not None:
            others = [g.noun for g in self.groups if self.subject and g.noun != self.subject.noun]
            return others[-1] if others else None
        group = self._group()
        return None if group is None else group.noun

    def _group(self) -> _Group | None:
        """Read a number and a noun, or a room, if they come next."""
        start = self.at
        bound = self._phrase(list(BOUNDS))
        definite = self._phrase(("the",)) is not None
        number: int | None = None
        if self.at < len(self.tokens) and self.tokens[self.at].isdecimal():
            number = int(self.tokens[self.at])
            self.at += 1
        elif (word := self._phrase(list(NUMBERS))) is not None:
            number = NUMBERS[word]
            if word == "without":
                self._phrase(("a", "an", "any"))
        some = number is None and self._phrase(("some", "any")) is not None
        sized = self._phrase((_SIZE_TOKEN,)) is not None
        if self._room(number, bound):
            return None
        plural, noun = self._noun()
        if noun is None:
            self.at = start
            return None
        if sized:
            raise _other_length(f"of the {noun.replace('_', ' ')}")
        sign = BOUNDS[bound] if bound else ""
        if number is None:
            number = 2 if plural and not definite and not some else 1
            sign = ">=" if not definite else sign
        group = _Group(noun, number, sign, not definite)
        if noun in ("door", "window"):
            self._opening(group)
        self.groups.append(group)
        self.subject = group
        return group

    def _room(self, number: int | None, bound: str | None) -> bool:
        """Read a room type, and refuse a type that the prior does not draw."""
        room = self._phrase(list(ROOMS))
        if room is None:
            return False
        ends = ROOMS[room]
        if ends and self.label_set.startswith("front3d_") and not self.label_set.endswith(ends):
            raise InputError(
                f"The request is for a {room}, but this prior draws rooms of "
                f"'{self.label_set}'; take another prior, or leave the room type out."
            )
        if number not in (None, 1) or bound:
            self.strange.append(room)
        return True

    def _noun(self) -> tuple[bool, str | None]:
        """Read a noun: whether it is a plural, and its class; (False, None) if there is none."""
        names = {noun: (False, noun) for noun in (*self.nouns, "door", "window")}
        names |= {plural: (True, noun) for noun in list(names) for plural in _plurals(noun)}
        found = self._phrase(list(names))
        if found is None:
            return False, None
        plural, noun = names[found]
        if noun in ("door", "window"):
            return plural, noun
        classes = self.nouns[noun]
        return plural, next((name for name in classes if name in self.known), classes[0])

    def _opening(self, group: _Group) -> None:
        """Add the doors or windows of a group, on the wall that is named next, if any."""
        wall = ""
        for direction in WALLS:
            words = [f"{word} the {direction}" for word in ("in", "on", "to", "at")]
            if self._phrase([f"{each} wall" for each in words] + words) is not None:
                wall = f"@{direction}"
        if group.new and group.bound != "<=":
            self.openings += [f"{group.noun}{wall}"] * group.number


def _plurals(noun: str) -> list[str]:
    return [f"{noun}s", f"{noun[:-1]}ves"] if noun.endswith("f") else [f"{noun}s", f"{noun}es"]

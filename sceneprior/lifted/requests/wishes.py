"""Wishes: constraints of a request on the numbers of objects in a room, and on their relations."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sceneprior.core.checked import shown
from sceneprior.core.classes import unknown_class
from sceneprior.core.errors import InputError

TO_ROOM = ("at a wall", "in a corner")
"""Relations to the room, which have no target."""
TO_TARGET = ("beside", "in front of", "facing", "under", "near", "far from")
"""Relations to another object, a door or a window."""
RELATIONS = (*TO_TARGET, *TO_ROOM)
OPENINGS = ("door", "window")
"""Targets that are not furniture."""
_COUNT = re.compile(r"\s*(>=|<=|=|)\s*(\d+)\s*")
_ENTRY = re.compile(r"(\w+)\s*:\s*(\S.*)")


@dataclass(frozen=True)
class CountWish:
    """Bounds on the number of objects of a class in a room, which includes the given objects."""

    label: str
    least: int
    most: int | None = None
    """None for no upper bound."""

    def __str__(self) -> str:
        if self.most is None:
            return f"at least {self.least} {self.label}"
        if self.least == self.most:
            return f"{self.least} {self.label}"
        return f"at most {self.most} {self.label}"

    def holds(self, count: int) -> bool:
        """True if a room with this many objects of the class meets the wish."""
        return self.least <= count and (self.most is None or count <= self.most)


@dataclass(frozen=True)
class RelationWish:
    """Wish that at least `count` objects of a class have a relation to the room, to an object of
    the target's class, or to a door or window."""

    subject: str
    relation: str
    target: str | None = None
    """A class, `door` or `window`; None for relations to the room."""
    count: int = 1

    def __str__(self) -> str:
        number = "" if self.count == 1 else f"{self.count} "
        return f"{number}{self.subject} {self.relation} {self.target or ''}".strip()


@dataclass(frozen=True)
class Wishes:
    """All wishes of a request."""

    counts: tuple[CountWish, ...] = ()
    relations: tuple[RelationWish, ...] = ()

    def bounds(self, label: str) -> tuple[int, int | None]:
        """Smallest and largest number of objects of a class that meet all wishes; subjects and
        targets of relations are required, too."""
        own = [wish for wish in self.counts if wish.label == label]
        least = max([0, *(wish.least for wish in own), *self._needed(label)])
        most = min((wish.most for wish in own if wish.most is not None), default=None)
        return least, most

    def _needed(self, label: str) -> list[int]:
        """Number of objects of a class that each relation needs."""
        needed = []
        for wish in self.relations:
            alike = wish.subject == wish.target
            if wish.subject == label:
                needed.append(max(wish.count, 2 if alike else 1))
            elif wish.target == label:
                needed.append(1)
        return needed

    @property
    def labels(self) -> list[str]:
        """Classes that the wishes name, each once."""
        named = [wish.label for wish in self.counts]
        for wish in self.relations:
            named += [wish.subject, *([wish.target] if wish.target else [])]
        return [label for label in dict.fromkeys(named) if label not in OPENINGS]


def count_wish(label: str, value: Any) -> CountWish:
    """A wish from a class and a number: 2, ">=1" or "<=3".

    >>> str(count_wish("wardrobe", ">=1")), str(count_wish("nightstand", 2))
    ('at least 1 wardrobe', '2 nightstand')

    Raises:
        InputError: `value` has another form.
    """
    found = None
    if isinstance(value, str):
        found = _COUNT.fullmatch(value)
    elif isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        found = _COUNT.fullmatch(str(value))
    if found is None:
        raise InputError(
            f"The wish for {label} is {str(value)[:40]!r}; expected a number of objects such as 2, "
            '">=1" or "<=3".'
        )
    sign, number = found.group(1), int(found.group(2))
    if sign == ">=":
        return CountWish(label, number)
    return CountWish(label, 0 if sign == "<=" else number, number)


def counts_of_text(text: str) -> dict[str, str] | None:
    """Numbers of objects by class from text such as `double_bed: 1, desk: 0`; None for other text.

    >>> counts_of_text("double_bed: 1, nightstand: >=2")
    {'double_bed': '1', 'nightstand': '>=2'}

    Raises:
        InputError: a class is listed twice.
    """
    counts: dict[str, str] = {}
    for part in re.split("[,;]", text):
        if (entry := _ENTRY.fullmatch(part.strip())) is None:
            return None
        label, number = entry.groups()
        if label in counts:
            raise InputError(f"The wishes list {label} twice; name each class once.")
        counts[label] = number
    return counts


def relation_wish(entry: Mapping[str, Any]) -> RelationWish:
    """A wish from the keys `subject`, `relation`, `target` and `count`.

    Raises:
        InputError: a key is missing or wrong.
    """
    known = {"subject", "relation", "target", "count"}
    if not {"subject", "relation"} <= entry.keys() <= known:
        raise InputError(
            f"A relation has the keys {', '.join(sorted(entry))}; expected subject and relation, "
            "with target and count where they apply."
        )
    subject, relation, target = (entry.get(key) for key in ("subject", "relation", "target"))
    count = entry.get("count", 1)
    if relation not in RELATIONS:
        raise InputError(f"No relation is called '{relation}'; choose from {', '.join(RELATIONS)}.")
    if (target is None) != (relation in TO_ROOM):
        needs = "takes no target" if relation in TO_ROOM else "needs a target"
        raise InputError(f"The relation '{relation}' {needs}; the request has {target!r}.")
    if not isinstance(count, int) or isinstance(count, bool) or count < 1:
        raise InputError(f"A relation has count {count!r}; expected a whole number above 0.")
    return RelationWish(str(subject), str(relation), None if target is None else str(target), count)


def check_wishes(wishes: Wishes, known: Sequence[str], given: Mapping[str, int], most: int) -> None:
    """Reject wishes that no room of a prior can meet.

    Args:
        known: Classes that the prior draws.
        given: Objects that are already in the room, by class.
        most: Maximum number of objects in a room.

    Raises:
        InputError: a class is unknown, or counts and relations contradict each other.
    """
    total = 0
    for label in dict.fromkeys([*wishes.labels, *given]):
        least, largest = wishes.bounds(label)
        here = given.get(label, 0)
        if label not in known and (least > here or label not in given):
            raise unknown_class(label, known)
        if largest is not None and least > largest:
            raise InputError(
                f"The wishes need {least} {label} and allow {largest}; change one of them."
            )
        if largest is not None and here > largest:
            raise InputError(
                f"The room is given with {here} {label}, and the wishes allow {largest}; change "
                "one of them."
            )
        total += max(least, here)
    if total > most:
        raise InputError(
            f"The given and the requested objects are {total} together, but rooms of this run "
            f"hold at most {most} (model.max_objects); ask for fewer."
        )


def read_wishes(want: Any) -> Wishes:
    """Wishes from a mapping of classes to numbers, with relations under the key `relations`.

    >>> [str(wish) for wish in read_wishes({"nightstand": 2, "desk": "<=1"}).counts]
    ['2 nightstand', 'at most 1 desk']

    Raises:
        InputError: a wish has another form.
    """
    relations = want.get("relations", []) if isinstance(want, Mapping) else None
    if not isinstance(relations, Sequence) or not all(isinstance(e, Mapping) for e in relations):
        raise InputError(
            f"The wishes are {shown(want)}; expected a sentence, or numbers of objects by class "
            "and a list `relations`."
        )
    numbers = {key: value for key, value in want.items() if key != "relations"}
    return Wishes(
        tuple(count_wish(key, value) for key, value in numbers.items()),
        tuple(relation_wish(entry) for entry in relations),
    )

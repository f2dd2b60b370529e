"""Conditions of a requested room: wishes for numbers of objects and their relations, the floor,
doors and windows, and given objects."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from sceneprior.core.arrangements import BEDS, CHAIRS, NIGHTSTANDS, OPENED, TABLES
from sceneprior.core.checked import plain, shown
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening, SceneObject
from sceneprior.core.scene_json import MOST_OBJECTS
from sceneprior.lifted.requests.floors import Floor
from sceneprior.lifted.requests.openings import WantedOpening

TO_ROOM = ("at a wall", "in a corner", "back to a wall", "with a free front")
"""Relations to the room, which have no target."""
TO_TARGET = (
    "beside", "on both sides of", "at the foot of", "at", "against", "opposite", "in front of",
    "facing", "under", "near", "far from",
)  # fmt: skip
"""Relations to another object, a door or a window."""
RELATIONS = (*TO_TARGET, *TO_ROOM)
OPENINGS = ("door", "window")
"""Targets that are not furniture."""
_COUNT = re.compile(r"\s*(>=|<=|=|)\s*(\d+)\s*")
_ENTRY = re.compile(r"\s*(\w+)\s*:\s*(\S.*?)\s*")


@dataclass(frozen=True)
class CountWish:
    """Bounds on the number of objects of a class, or of doors or windows, in a room, which includes
    the given ones."""

    label: str
    least: int
    most: int | None = None
    """None for no upper bound."""
    said: str = field(default="", compare=False)
    """Words of a sentence that express the wish, for messages."""

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

    @property
    def needs_free_front(self) -> bool:
        """True if the floor before the subject must be free."""
        at_wall = self.relation == "at a wall" and self.subject in OPENED
        return at_wall or self.relation == "with a free front"

    def __str__(self) -> str:
        number = "" if self.count == 1 else f"{self.count} "
        return f"{number}{self.subject} {self.relation} {self.target or ''}".strip()


@dataclass(frozen=True)
class Wishes:
    """All wishes of a request."""

    counts: tuple[CountWish, ...] = ()
    relations: tuple[RelationWish, ...] = ()

    @cached_property
    def needs(self) -> dict[str, list[CountWish]]:
        """Bounds by class or kind of opening; relations require their subjects and targets."""
        needs = list(self.counts)
        for wish in self.relations:
            least = max(wish.count, 2 if wish.subject == wish.target else 1)
            needs.append(CountWish(wish.subject, least, said=str(wish)))
            if wish.target is not None:
                needs.append(CountWish(wish.target, 1, said=str(wish)))
        return {n.label: [each for each in needs if each.label == n.label] for n in needs}

    @cached_property
    def bounds(self) -> dict[str, tuple[int, int | float]]:
        """Smallest and largest numbers that meet all `needs`."""
        return {
            label: (
                max(n.least for n in own),
                min(math.inf if n.most is None else n.most for n in own),
            )
            for label, own in self.needs.items()
        }

    @cached_property
    def implied(self) -> tuple[RelationWish, ...]:
        """Relations of the required objects that go without saying: fronts are free, chairs stand
        at a table, two nightstands at their bed. Those of objects with a relation of the request
        are left to it."""
        least = {label: low for label, (low, _) in self.bounds.items() if low}
        said = {(wish.subject, wish.relation) for wish in self.relations}
        placed = {wish.subject for wish in self.relations}
        found = [
            RelationWish(label, "with a free front", None, least[label])
            for label in OPENED
            if label in least and (label, "at a wall") not in said
        ]
        for chair in CHAIRS:
            left = 0 if chair in placed else least.get(chair, 0)
            for table in filter(least.__contains__, TABLES):  # `table` is the last, for the rest
                count = left if table == "table" else min(left, 1)
                found += [RelationWish(chair, "at", table, count)] * bool(count)
                left -= count
        beds = [label for label in BEDS if label in least]
        for stand in NIGHTSTANDS:
            if len(beds) == least.get(beds[0] if beds else "") == 1 and least.get(stand) == 2:
                found.append(RelationWish(stand, "on both sides of", beds[0], 2))
        return tuple(wish for wish in found if wish not in self.relations)


@dataclass(frozen=True)
class Conditions:
    """Conditions that the rooms of a request must meet, as a prior understands them."""

    classes: tuple[str, ...]
    """Names of the prior's classes, `void` included."""
    floor: Floor | None = None
    """None draws a rectangle for each room."""
    openings: tuple[Opening | WantedOpening, ...] = ()
    ceiling_m: float | None = None
    wishes: Wishes = Wishes()
    objects: tuple[SceneObject, ...] = ()
    """Given objects, which stay as they are."""

    @property
    def required(self) -> list[int]:
        """The class index of each object that the wishes require beyond the given ones."""
        given = Counter(item.label for item in self.objects)
        return [
            self.classes.index(label)
            for label, (least, _) in self.wishes.bounds.items()
            if label not in OPENINGS
            for _ in range(least - given[label])
        ]

    @property
    def most(self) -> list[float]:
        """Largest number of objects of each class."""
        bounds = {key: own for key, own in self.wishes.bounds.items() if key not in OPENINGS}
        return [float(bounds.get(label, (0, math.inf))[1]) for label in self.classes]

    @property
    def has_rules(self) -> bool:
        """True if there are conditions that the network does not know, so that places of objects
        must be checked: wishes, openings, a ceiling, or a floor that is not a rectangle."""
        odd_floor = self.floor is not None and not self.floor.is_rectangle
        return bool(self.openings or self.wishes.needs or self.ceiling_m or odd_floor)


def read_wishes(want: Any) -> Wishes | None:
    """Wishes from a mapping of classes to numbers, with relations under the key `relations`, or
    from text such as `double_bed: 1, desk: 0`; None for other text, which is a sentence.

    >>> [str(wish) for wish in read_wishes({"nightstand": 2, "desk": "<=1"}).counts]
    ['2 nightstand', 'at most 1 desk']

    Raises:
        InputError: a wish has another form, or a class is listed twice.
    """
    if isinstance(want, str):
        entries = [_ENTRY.fullmatch(part) for part in re.split("[,;]", want)]
        if not all(entries):
            return None
        pairs = [(entry[1], entry[2]) for entry in entries if entry]
        want = dict(pairs)
        if len(want) < len(pairs):
            ((label, _),) = Counter(label for label, _ in pairs).most_common(1)
            raise InputError(f"The wishes list {label} twice; name each class once.")
    relations = want.get("relations", []) if isinstance(want, Mapping) else None
    if not isinstance(relations, Sequence) or not all(isinstance(e, Mapping) for e in relations):
        raise InputError(
            f"The wishes are {shown(want)}; expected a sentence, or numbers of objects by class "
            "and a list `relations`."
        )
    return Wishes(
        tuple(count_wish(key, value) for key, value in want.items() if key != "relations"),
        tuple(relation_wish(entry) for entry in relations),
    )


def count_wish(label: str, value: Any) -> CountWish:
    """A wish from a class and a number: 2, ">=1" or "<=3".

    >>> str(count_wish("wardrobe", ">=1")), str(count_wish("nightstand", 2))
    ('at least 1 wardrobe', '2 nightstand')

    Raises:
        InputError: `value` has another form.
    """
    if isinstance(value, int) and not isinstance(value, bool):
        value = shown(value)  # Python writes no integers of more than 4,300 digits
    if not isinstance(value, str) or (found := _COUNT.fullmatch(value)) is None:
        raise InputError(
            f"The wish for {plain(label)} is {str(value)[:40]!r}; expected a number of objects "
            'such as 2, ">=1" or "<=3".'
        )
    sign, number = found.group(1), count_of(found.group(2))
    if sign == ">=":
        return CountWish(label, number)
    return CountWish(label, 0 if sign == "<=" else number, number)


def count_of(digits: str) -> int:
    """The number of objects that digits stand for.

    Raises:
        InputError: it is above `MOST_OBJECTS`.
    """
    if len(digits) > 9 or int(digits) > MOST_OBJECTS:
        raise InputError(
            f"The request has the number {plain(digits, 30)}; expected at most {MOST_OBJECTS} "
            "objects."
        )
    return int(digits)


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
        raise InputError(
            f"No relation is called {shown(relation)}; choose from {', '.join(RELATIONS)}."
        )
    if not isinstance(subject, str) or subject in OPENINGS:
        raise InputError(f"The subject of a relation is {shown(subject)}; expected a class.")
    if (target is None) != (relation in TO_ROOM):
        needs = "takes no target" if relation in TO_ROOM else "needs a target"
        raise InputError(f"The relation '{relation}' {needs}; the request has {shown(target)}.")
    if not isinstance(count, int) or isinstance(count, bool) or not 0 < count <= MOST_OBJECTS:
        raise InputError(
            f"A relation has count {shown(count)}; expected a whole number from 1 to "
            f"{MOST_OBJECTS}."
        )
    named = None if target is None else plain(str(target))
    return meant_relation(subject, str(relation), named, count)


def meant_relation(subject: str, relation: str, target: str | None, count: int) -> RelationWish:
    """A relation as people mean it: two nightstands beside a bed stand on its two sides."""
    if relation == "beside" and target in BEDS and subject in NIGHTSTANDS and count == 2:
        relation = "on both sides of"
    return RelationWish(
        subject, relation, target, max(count, 2) if relation == "on both sides of" else count
    )

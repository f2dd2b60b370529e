"""Conditions of a requested room: wishes for numbers of objects and their relations, the floor,
doors and windows, and given objects."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from sceneprior.core.checked import shown
from sceneprior.core.classes import unknown_class
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening, SceneObject
from sceneprior.lifted.requests.floors import Floor
from sceneprior.lifted.requests.openings import WantedOpening

TO_ROOM = ("at a wall", "in a corner")
"""Relations to the room, which have no target."""
TO_TARGET = ("beside", "in front of", "facing", "under", "near", "far from")
"""Relations to another object, a door or a window."""
RELATIONS = (*TO_TARGET, *TO_ROOM)
OPENINGS = ("door", "window")
"""Targets that are not furniture."""
_COUNT = re.compile(r"\s*(>=|<=|=|)\s*(\d+)\s*")
_ENTRY = re.compile(r"\s*(\w+)\s*:\s*(\S.*?)\s*")


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

    @cached_property
    def bounds(self) -> dict[str, tuple[int, int | float]]:
        """Smallest and largest number of objects, by class, that meet all wishes; subjects and
        targets of relations are required, too."""
        needs = [
            (wish.label, wish.least, math.inf if wish.most is None else wish.most)
            for wish in self.counts
        ]
        for wish in self.relations:
            alike = wish.subject == wish.target
            needs.append((wish.subject, max(wish.count, 2 if alike else 1), math.inf))
            if wish.target is not None:
                needs.append((wish.target, 1, math.inf))
        bounds: dict[str, tuple[int, int | float]] = {}
        for label, least, most in needs:
            if label not in OPENINGS:
                low, high = bounds.get(label, (0, math.inf))
                bounds[label] = max(low, least), min(high, most)
        return bounds


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
            for _ in range(least - given[label])
        ]

    @property
    def most(self) -> list[float]:
        """Largest number of objects of each class."""
        return [float(self.wishes.bounds.get(label, (0, math.inf))[1]) for label in self.classes]

    @property
    def has_rules(self) -> bool:
        """True if there are conditions that the network does not know, so that places of objects
        must be checked: openings, a ceiling, relations, or a floor that is not a rectangle."""
        odd_floor = self.floor is not None and not self.floor.is_rectangle
        return bool(self.openings or self.wishes.relations or self.ceiling_m or odd_floor)

    def check_wishes(self, known: Sequence[str], most: int) -> None:
        """Reject wishes that no room of a prior can meet.

        Args:
            known: Classes that the prior draws.
            most: Maximum number of objects in a room.

        Raises:
            InputError: a class is unknown, or counts and relations contradict each other.
        """
        given, total = Counter(item.label for item in self.objects), 0
        for label in dict.fromkeys([*self.wishes.bounds, *given]):
            least, largest = self.wishes.bounds.get(label, (0, math.inf))
            if label not in known and (least > given[label] or label not in given):
                raise unknown_class(label, known)
            if least > largest:
                raise InputError(
                    f"The wishes need {least} {label} and allow {largest}; change one of them."
                )
            if given[label] > largest:
                raise InputError(
                    f"The room is given with {given[label]} {label}, and the wishes allow "
                    f"{largest}; change one of them."
                )
            total += max(least, given[label])
        if total > most:
            raise InputError(
                f"The given and the requested objects are {total} together, but rooms of this run "
                f"hold at most {most} (model.max_objects); ask for fewer."
            )


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
    is_number = isinstance(value, str | int) and not isinstance(value, bool)
    if not is_number or (found := _COUNT.fullmatch(str(value))) is None:
        raise InputError(
            f"The wish for {label} is {str(value)[:40]!r}; expected a number of objects such as 2, "
            '">=1" or "<=3".'
        )
    sign, number = found.group(1), int(found.group(2))
    if sign == ">=":
        return CountWish(label, number)
    return CountWish(label, 0 if sign == "<=" else number, number)


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

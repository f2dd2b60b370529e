"""Requests for rooms: floor, doors and windows, ceiling, wishes and given objects."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening, SceneObject
from sceneprior.core.scene_json import check_box, unit_guess
from sceneprior.lifted.requests.openings import Openings, WantedOpening, moved, read_openings
from sceneprior.lifted.requests.relations import OPENINGS
from sceneprior.lifted.requests.sentence import read_sentence
from sceneprior.lifted.requests.shape import read_floor
from sceneprior.lifted.requests.wishes import (
    CountWish,
    RelationWish,
    Wishes,
    count_wish,
    counts_of_text,
    relation_wish,
)

HIGHEST_M = 20.0
"""Highest ceiling that can be requested."""
Floor = str | Sequence[Any] | np.ndarray
Want = str | Mapping[str, Any]


@dataclass(frozen=True)
class Request:
    """Conditions that sampled rooms must meet, validated; lengths in metres."""

    outline_m: np.ndarray | None = None
    """Corners (x, z) of the floor; with None, a rectangle is drawn for each room."""
    openings: tuple[Opening | WantedOpening, ...] = ()
    ceiling_m: float | None = None
    wishes: Wishes = field(default_factory=Wishes)
    objects: tuple[SceneObject, ...] = ()
    """Given objects, which stay as they are."""

    @property
    def given(self) -> Counter[str]:
        """Number of given objects of each class."""
        return Counter(item.label for item in self.objects)


def make_request(
    known: Sequence[str],
    label_set: str,
    floor: Floor | None = None,
    openings: Openings | None = None,
    ceiling_m: float | None = None,
    want: Want | None = None,
    objects: Sequence[SceneObject] = (),
) -> Request:
    """Validate the parts of a request, and put them together.

    Args:
        known: Classes that the prior draws.
        label_set: Name of the prior's label set.
        floor: See `read_floor`. Unless there are objects, the floor is moved so that the centre of
            its bounding box is the origin.
        openings: Doors and windows; see `read_openings`.
        ceiling_m: Height of the ceiling.
        want: A sentence (`read_sentence`), a mapping (`read_wishes`), or numbers of objects by
            class as text (`counts_of_text`).
        objects: Given objects, in the coordinates of the floor.

    Raises:
        InputError: a part is invalid, or contradicts another.
    """
    placed = () if openings is None else read_openings(openings)
    if isinstance(want, str) and (counts := counts_of_text(want)) is not None:
        want = counts
    if isinstance(want, str):
        sentence = read_sentence(want, known, label_set)
        if floor is not None and sentence.floor is not None:
            raise InputError(
                f"The floor is given, and the sentence asks for {sentence.floor} m; leave one out."
            )
        floor = sentence.floor if floor is None else floor
        placed += read_openings(sentence.openings)
        wishes = sentence.wishes
    else:
        wishes = Wishes() if want is None else read_wishes(want)
    for item in objects:
        check_box("The request", item.label, item.center_m, item.size_m)
    targets = {wish.target for wish in wishes.relations}
    for kind in OPENINGS:  # a relation to a door or a window needs such an opening
        if kind in targets and all(each.kind != kind for each in placed):
            placed += read_openings(kind)
    outline_m = None if floor is None else read_floor(floor)
    if outline_m is not None and not objects:
        middle = (outline_m.min(axis=0) + outline_m.max(axis=0)) / 2
        outline_m, placed = outline_m - middle, moved(placed, -middle)
    if outline_m is None and any(isinstance(each, Opening) for each in placed):
        raise InputError(
            "An opening has corners, which lie on the walls of a floor; give the floor, too, or "
            "write door or window@north."
        )
    if ceiling_m is not None and not 1.0 <= ceiling_m <= HIGHEST_M:
        guess = f" {unit_guess(ceiling_m)}" if ceiling_m > HIGHEST_M else ""
        raise InputError(
            f"The ceiling is {ceiling_m:g} m high; expected 1 to {HIGHEST_M:g} m above the floor."
            f"{guess}"
        )
    return Request(outline_m, placed, ceiling_m, wishes, tuple(objects))


def read_wishes(want: Mapping[str, Any]) -> Wishes:
    """Wishes from a mapping of classes to numbers, with relations under the key `relations`.

    >>> [str(wish) for wish in read_wishes({"nightstand": 2, "desk": "<=1"}).counts]
    ['2 nightstand', 'at most 1 desk']
    """
    counts: list[CountWish] = []
    relations: list[RelationWish] = []
    for key, value in want.items():
        if key == "relations":
            relations += [relation_wish(entry) for entry in value]
        else:
            counts.append(count_wish(key, value))
    return Wishes(tuple(counts), tuple(relations))

"""A request for rooms: floor, doors and windows, ceiling, wishes and given objects."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sceneprior.core.errors import InputError
from sceneprior.core.scene import SceneObject
from sceneprior.lifted.requests.shape import read_floor
from sceneprior.lifted.requests.wishes import (
    CountWish,
    RelationWish,
    Wishes,
    count_wish,
    relation_wish,
)

HIGHEST_M = 20.0
"""Highest ceiling that can be requested."""
Floor = str | Sequence[Any] | np.ndarray
Want = Mapping[str, Any]


@dataclass(frozen=True)
class Request:
    """Conditions of the rooms to draw, checked; lengths in metres."""

    outline_m: np.ndarray | None = None
    """Corners (x, z) of the floor; None draws a rectangle for each room."""
    ceiling_m: float | None = None
    wishes: Wishes = field(default_factory=Wishes)
    objects: tuple[SceneObject, ...] = ()
    """Given objects, which stay as they are."""

    @property
    def given(self) -> Counter[str]:
        """Number of given objects of each class."""
        return Counter(item.label for item in self.objects)


def make_request(
    floor: Floor | None = None,
    ceiling_m: float | None = None,
    want: Want | None = None,
    objects: Sequence[SceneObject] = (),
) -> Request:
    """A checked request.

    Args:
        floor: See `read_floor`. Unless there are objects, its coordinates are moved so that the
            centre of its bounding box is the origin.
        ceiling_m: Height of the ceiling.
        want: See `read_wishes`.
        objects: Given objects, in the coordinates of the floor.

    Raises:
        InputError: a part cannot be used.
    """
    outline_m = None if floor is None else read_floor(floor)
    if outline_m is not None and not objects:
        outline_m = outline_m - (outline_m.min(axis=0) + outline_m.max(axis=0)) / 2
    if ceiling_m is not None and not 1.0 <= ceiling_m <= HIGHEST_M:
        raise InputError(
            f"The ceiling is {ceiling_m:g} m high; expected 1 to {HIGHEST_M:g} m above the floor."
        )
    wishes = Wishes() if want is None else read_wishes(want)
    return Request(outline_m, ceiling_m, wishes, tuple(objects))


def read_wishes(want: Want) -> Wishes:
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

"""Checks of requested relations, in furnished rooms and in partly furnished ones."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.lifted.requests.relations import (
    OPENINGS,
    OUTWARD,
    Items,
    opening_items,
    related,
    related_to_room,
)
from sceneprior.lifted.requests.shape import RoomShape
from sceneprior.lifted.requests.wishes import RelationWish
from sceneprior.lifted.rooms import PosedRooms
from sceneprior.lifted.sampler.frames import side_of
from sceneprior.lifted.sampler.network import RoomSampler


class Furniture(NamedTuple):
    """Objects of a room, with their classes; all arrays have a row per object."""

    boxes_m: Float[np.ndarray, "objects 6"]
    """Centre and full extents."""
    object_class: Int[np.ndarray, " objects"]
    back: Int[np.ndarray, " objects"]
    """Side that is nearest to walls on average: 0 to 3 for low z, low x, high z, high x."""
    front: Int[np.ndarray, " objects"]
    """Side of the front, numbered in the same way; it need not be opposite to `back`."""

    def rows(self, rows: Int[np.ndarray, " some"] | slice) -> "Furniture":
        """The objects of these rows."""
        return Furniture(*(part[rows] for part in self))

    def joined(self, others: "Furniture") -> "Furniture":
        """These objects, followed by others."""
        return Furniture(*map(np.concatenate, zip(self, others, strict=True)))

    def items(self, classes: Sequence[str]) -> Items:
        """The objects in the form that relations are computed from."""
        is_lamp = np.array(["lamp" in classes[index] for index in self.object_class], dtype=bool)
        return Items(self.boxes_m, OUTWARD[self.front], is_lamp)


def furniture_of(
    sampler: RoomSampler,
    boxes_m: Float[Tensor, "objects 6"],
    object_class: Int[Tensor, " objects"],
    looks: Int[Tensor, " objects"],
) -> Furniture:
    """Objects, with the sides of their backs and fronts, which follow from their looks."""
    back, front = (side_of(looks, sides).numpy() for sides in (sampler.backs, sampler.fronts))
    return Furniture(boxes_m.double().numpy(), object_class.numpy(), back, front)


def furniture_in(sampler: RoomSampler, rooms: PosedRooms, row: int) -> Furniture:
    """The objects of a room in a batch."""
    assert rooms.looks is not None
    here = rooms.is_object[row]
    parts = (part[row, here] for part in (rooms.boxes_m, rooms.object_class, rooms.looks))
    return furniture_of(sampler, *parts)


class RelationChecks:
    """Checks of the requested relations of one room.

    Args:
        wishes: The requested relations.
        shape: Floor, doors and windows.
        classes: Names of the classes by index.
    """

    def __init__(self, wishes: Sequence[RelationWish], shape: RoomShape, classes: Sequence[str]):
        self.wishes, self.shape, self.classes = wishes, shape, classes
        self.openings = {kind: opening_items(shape, kind) for kind in OPENINGS}

    def held(self, furniture: Furniture) -> list[bool]:
        """True for each relation that holds in a furnished room."""
        items = furniture.items(self.classes)
        return [
            int(self._met(wish, items, furniture.object_class).sum()) >= wish.count
            for wish in self.wishes
        ]

    def can_hold(
        self, label: int, candidates: Furniture, placed: Furniture, upcoming: Sequence[int]
    ) -> Bool[np.ndarray, " candidates"]:
        """True for places of the next object, of class `label`, after which every relation is still
        possible. Upcoming objects are assumed to find places in which their relations hold."""
        possible = np.ones(len(candidates.back), dtype=bool)
        name = self.classes[label]
        for wish in self.wishes:
            if name not in (wish.subject, wish.target):
                continue
            later = [self.classes[index] for index in upcoming]
            if wish.target in later:
                continue
            needed = wish.count - later.count(wish.subject)
            for row in np.flatnonzero(possible):
                joined = placed.joined(candidates.rows(slice(row, row + 1)))
                met = self._met(wish, joined.items(self.classes), joined.object_class)
                possible[row] = met.sum() >= needed
        return possible

    def _met(
        self, wish: RelationWish, items: Items, object_class: Int[np.ndarray, " objects"]
    ) -> Bool[np.ndarray, " subjects"]:
        """True for each object of the subject's class for which the relation holds."""
        names = np.array([self.classes[index] for index in object_class], dtype=object)
        own = np.flatnonzero(names == wish.subject)
        subjects = items.rows(own)
        if wish.target is None:
            return related_to_room(wish.relation, subjects, self.shape)
        if wish.target in OPENINGS:
            there = self.openings[wish.target]
            found = related(wish.relation, subjects, there, wish.target == "window")
        else:
            theirs = np.flatnonzero(names == wish.target)
            found = related(wish.relation, subjects, items.rows(theirs))
            found &= own[:, None] != theirs[None]
        return np.asarray(found.any(axis=1))

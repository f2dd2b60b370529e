"""Plans of rooms: rectangle and list of classes, given or sampled."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.lifted.rooms import PosedRooms
from sceneprior.lifted.sampler.network import RoomSampler
from sceneprior.lifted.sampler.rooms import large_first, rectangle_sides, rectangles_of

RECTANGLES = 16
"""Number of rectangles sampled for a room; the first one that contains the given objects is
used."""
BEYOND_M = 0.01
"""Distance that an object may extend beyond the rectangle."""


@dataclass(frozen=True)
class Given:
    """Conditions of the rooms to draw, one row per room."""

    objects: PosedRooms
    """Objects that are already there; looks need not be known."""
    rectangle_m: Float[Tensor, "rooms 4"] | None = None
    """Rectangle that the furniture may fill: centre x, z and extents x, z. None samples it."""
    coming: Int[Tensor, "rooms wanted"] | None = None
    """Classes of all objects to add, in any order, padded with `END`. None samples the classes."""


class Plan(NamedTuple):
    """Conditions of rooms before they are furnished: those of `Given`, completed by sampling."""

    objects: PosedRooms
    rectangle_m: Float[Tensor, "rooms 4"]
    coming: Int[Tensor, "rooms slots"]
    drawn: bool
    """True if the rectangles were sampled; given ones may be larger than the furniture."""

    def rows(self, rows: Int[Tensor, " some"]) -> "Plan":
        """This plan, reduced to the rooms with these indices."""
        objects = self.objects.changed(lambda each: each[rows])
        return Plan(objects, self.rectangle_m[rows], self.coming[rows], self.drawn)


def nothing_given(rooms: int) -> Given:
    """Empty conditions, to draw whole rooms."""
    none = torch.zeros(rooms, 0, dtype=torch.int64)
    return Given(PosedRooms(none, none > 0, torch.zeros(rooms, 0, 6)))


def uniform_numbers(count: int, each: int, seed: tuple[int, int]) -> Float[Tensor, "rooms numbers"]:
    """Uniform random numbers, one row per room; a row does not depend on the number of rooms."""
    (state,) = np.random.SeedSequence(seed).generate_state(1, np.uint64)
    generator = torch.Generator().manual_seed(int(state >> np.uint64(1)))
    return torch.rand(count, each, generator=generator)


def plan_rooms(sampler: RoomSampler, given: Given, count: int, seed: tuple[int, int]) -> Plan:
    """Rectangles and classes, sampled where they are not given. Classes with the largest footprints
    come first, so that tables are placed before their chairs."""
    slots, objects, rectangle_m = sampler.max_objects, given.objects, given.rectangle_m
    numbers = uniform_numbers(count, 5 * RECTANGLES + slots, seed)
    frames, uniform = numbers.split([5 * RECTANGLES, slots], dim=1)
    if rectangle_m is None:
        choice, *normal = frames.unflatten(1, (RECTANGLES, 5)).unbind(dim=-1)
        noise = torch.special.ndtri(torch.stack(normal, dim=-1).clamp(1e-6, 1 - 1e-6))
        rectangle_m = holding(sampler.rectangles(choice, noise), objects)
    coming = given.coming
    if coming is None:
        counts = sampler.contents.before(objects.object_class, objects.is_object)[:, -1]
        free = slots - objects.is_object.sum(dim=1)
        coming = sampler.contents.draw(counts, free, rectangle_m[:, 2:], uniform)
    coming = F.pad(coming, (0, slots - coming.shape[1]))
    order = large_first(coming, sampler.footprints_m2, torch.zeros(coming.shape))
    drawn = given.rectangle_m is None
    return Plan(objects, rectangle_m, coming.gather(1, order), drawn)


def holding(tried: Float[Tensor, "rooms tries 4"], objects: PosedRooms) -> Float[Tensor, "rooms 4"]:
    """The first of the sampled rectangles that contains the given objects; if none does, the first
    one, enlarged until it does."""
    if not objects.is_object.any():
        return tried[:, 0]
    known = rectangles_of(objects).unsqueeze(1)
    low, high = rectangle_sides(tried)
    known_low, known_high = rectangle_sides(known)
    holds = ((low <= known_low + BEYOND_M) & (high >= known_high - BEYOND_M)).all(dim=-1)
    first = holds.int().argmax(dim=1)[:, None, None]
    low = torch.minimum(torch.take_along_dim(low, first, dim=1), known_low)[:, 0]
    high = torch.maximum(torch.take_along_dim(high, first, dim=1), known_high)[:, 0]
    grown = torch.cat([(low + high) / 2, high - low], dim=-1)
    return grown.where(objects.is_object.any(dim=1, keepdim=True), tried[:, 0])

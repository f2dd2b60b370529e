"""Search for a place for a required object when no place that the sampler draws is allowed:
candidates from the whole room are weighted by the sampler's density."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.core.boxes import QUARTERS
from sceneprior.core.mixtures import draw_index
from sceneprior.lifted.prototypes import turn_posed
from sceneprior.lifted.requests.placement_rules import PlacementRules
from sceneprior.lifted.requests.relation_checks import Furniture, furniture_of
from sceneprior.lifted.sampler.network import RoomSampler
from sceneprior.lifted.sampler.reading import Frame, Reading
from sceneprior.lifted.sampler.violations import violation

CANDIDATES = 128
"""Number of candidates, each a place and a rotation by quarter turns."""
COMPARED = 16
"""Largest number of allowed candidates whose densities are compared."""
FLUSH, ADJACENT = 0.5, 0.25
"""Probabilities, along each axis, that a candidate is flush with a side of a rectangle in the
floor, and that it is adjacent to an object or flush with it."""


class Unplaced(NamedTuple):
    """An object that has no place yet."""

    label: int
    look: int
    size_m: Float[Tensor, "3"]
    bottom_m: float


def search(
    sampler: RoomSampler,
    reading: Reading,
    item: Unplaced,
    rules: PlacementRules,
    placed: Furniture,
    upcoming: Sequence[int],
    draws: np.random.Generator,
) -> tuple[int, Float[Tensor, "6"]] | str:
    """Find an allowed place: return the look, in one of four rotations, and the box, or the reason
    why no place was found.

    Importance sampling: one of at most `COMPARED` allowed places is drawn in proportion to the
    sampler's density.

    Args:
        reading: The outputs of the sampler's encoder for the particle, one row.
        placed: Objects in the room.
        upcoming: Classes of objects that are placed later.
    """
    quarters = torch.from_numpy(draws.integers(QUARTERS, size=CANDIDATES))
    looks = turn_posed(
        torch.full((CANDIDATES, 1), item.look), quarters, torch.zeros(CANDIDATES, dtype=torch.bool)
    )[:, 0]
    turned = (quarters % 2 == 1)[:, None]
    size_m = torch.where(turned, item.size_m.flip(-1), item.size_m)
    rectangles_m = rules.shape.rectangles_m
    chance = rectangles_m[:, 2:].prod(axis=1)
    rows = draws.choice(len(rectangles_m), size=CANDIDATES, p=chance / chance.sum())
    rectangle_m = torch.from_numpy(rectangles_m[rows]).float()
    centre = _places(size_m[:, ::2].numpy(), rectangle_m.numpy(), placed.boxes_m, draws)
    height_m = item.bottom_m + size_m[:, 1] / 2
    boxes_m = torch.stack([centre[:, 0], height_m, centre[:, 1], *size_m.unbind(dim=1)], dim=1)
    many = reading.rows(torch.zeros(CANDIDATES, dtype=torch.int64))
    many = many._replace(frame=Frame.plain(rectangle_m))
    apart = ~sampler.may_meet[item.label, many.before.object_class]
    free = (violation(boxes_m, many, apart) == 0).nonzero()[:, 0]
    if not len(free):
        return "free floor"
    candidates = furniture_of(
        sampler, boxes_m[free], torch.full((len(free),), item.label), looks[free]
    )
    allowed, reason = rules.allowed(
        item.label, candidates, placed, upcoming, rectangle_m[free].double().numpy(), COMPARED
    )
    fits = free[torch.from_numpy(np.flatnonzero(allowed)[:COMPARED])]
    if not len(fits):
        return reason
    label = torch.full((len(fits),), item.label)
    some = many.rows(fits)
    places = sampler.place(
        some, label, looks[fits], size_m[fits], torch.full((len(fits),), item.bottom_m)
    )
    density = places.log_prob(boxes_m[fits][:, [0, 2]])
    density = density + sampler.look_logits(some, label).gather(1, looks[fits][:, None])[:, 0]
    chosen = fits[int(draw_index(density[None], torch.tensor([draws.random()]).float()))]
    return int(looks[chosen]), boxes_m[chosen]


def _places(
    size_m: Float[np.ndarray, "candidates 2"],
    rectangle_m: Float[np.ndarray, "candidates 4"],
    placed_m: Float[np.ndarray, "objects 6"],
    draws: np.random.Generator,
) -> Float[Tensor, "candidates 2"]:
    """Random centres (x, z) in the rectangle: flush with a side, next to an object, or anywhere."""
    free = ((rectangle_m[:, 2:] - size_m) / 2).clip(min=0)
    middle = rectangle_m[:, :2]
    way = draws.random(size_m.shape)
    side = np.where(draws.random(size_m.shape) < 0.5, -1.0, 1.0)
    found = middle + free * (2 * draws.random(size_m.shape) - 1)
    found = np.where(way < FLUSH, middle + side * free, found)
    if len(placed_m):
        # One object for both axes, so that an item may stand beside a corner of the object.
        near = placed_m[draws.integers(len(placed_m), size=len(size_m))]
        own, theirs = size_m / 2, near[:, [3, 5]] / 2
        outside = draws.random(size_m.shape) < 0.5
        beside = near[:, [0, 2]] + side * np.where(outside, theirs + own, theirs - own)
        found = np.where((way >= FLUSH) & (way < FLUSH + ADJACENT), beside, found)
    return torch.from_numpy(found).float()

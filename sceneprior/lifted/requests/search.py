"""Searches a place for a wanted object if the sampler draws none that fits: candidates are spread
over the whole room, and one is chosen by the sampler's density."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.core.geometry.turns import QUARTERS
from sceneprior.core.mixtures import draw_index
from sceneprior.lifted.prototypes import turned_looks
from sceneprior.lifted.requests.holding import Furniture, furniture_of
from sceneprior.lifted.requests.judge import Judge
from sceneprior.lifted.sampler.network import RoomSampler
from sceneprior.lifted.sampler.reading import Frame, Reading
from sceneprior.lifted.sampler.violations import violation

CANDIDATES = 128
"""Number of candidates, each a place and a quarter turn."""
COMPARED = 16
"""Number of fitting candidates whose densities are compared."""
FLUSH, ADJACENT = 0.5, 0.25
"""Probabilities, along each axis, that a candidate stands flush with a side of a rectangle in the
floor, and next to an object or flush with it."""


class Piece(NamedTuple):
    """An object without a place."""

    label: int
    look: int
    size_m: Float[Tensor, "3"]
    bottom_m: float


def search(
    sampler: RoomSampler,
    reading: Reading,
    piece: Piece,
    judge: Judge,
    standing: Furniture,
    coming: Sequence[int],
    draws: np.random.Generator,
) -> tuple[int, Float[Tensor, "6"]] | str:
    """The look, turned by quarters, and the box of a place that fits; or what is in the way.

    Importance sampling: of `COMPARED` places that fit, one is drawn in proportion to the sampler's
    density.

    Args:
        reading: The encoder's outputs for the particle, one row.
        standing: The objects that are there.
        coming: Classes that come later.
    """
    quarters = torch.from_numpy(draws.integers(QUARTERS, size=CANDIDATES))
    looks = turned_looks(
        torch.full((CANDIDATES, 1), piece.look), quarters, torch.zeros(CANDIDATES, dtype=torch.bool)
    )[:, 0]
    turned = (quarters % 2 == 1)[:, None]
    size_m = torch.where(turned, piece.size_m.flip(-1), piece.size_m)
    rectangles_m = judge.shape.rectangles_m
    chance = rectangles_m[:, 2:].prod(axis=1)
    rows = draws.choice(len(rectangles_m), size=CANDIDATES, p=chance / chance.sum())
    rectangle_m = torch.from_numpy(rectangles_m[rows]).float()
    centre = _places(size_m[:, ::2].numpy(), rectangle_m.numpy(), standing.boxes_m, draws)
    height_m = piece.bottom_m + size_m[:, 1] / 2
    boxes_m = torch.stack([centre[:, 0], height_m, centre[:, 1], *size_m.unbind(dim=1)], dim=1)
    many = _framed(reading.rows(torch.zeros(CANDIDATES, dtype=torch.int64)), rectangle_m)
    apart = ~sampler.may_meet[piece.label, many.before.object_class]
    free = (violation(boxes_m, many, apart) == 0).nonzero()[:, 0]
    if not len(free):
        return "free floor"
    candidates = furniture_of(
        sampler, boxes_m[free], torch.full((len(free),), piece.label), looks[free]
    )
    allowed, hurdle = judge.allows(
        piece.label, candidates, standing, coming, rectangle_m[free].double().numpy(), COMPARED
    )
    fits = free[torch.from_numpy(np.flatnonzero(allowed)[:COMPARED])]
    if not len(fits):
        return hurdle
    label = torch.full((len(fits),), piece.label)
    some = many.rows(fits)
    places = sampler.place(
        some, label, looks[fits], size_m[fits], torch.full((len(fits),), piece.bottom_m)
    )
    density = places.log_prob(boxes_m[fits][:, [0, 2]])
    density = density + sampler.look_logits(some, label).gather(1, looks[fits][:, None])[:, 0]
    chosen = fits[int(draw_index(density[None], torch.tensor([draws.random()]).float()))]
    return int(looks[chosen]), boxes_m[chosen]


def _framed(reading: Reading, rectangle_m: Float[Tensor, "rooms 4"]) -> Reading:
    return reading._replace(frame=Frame.plain(rectangle_m))


def _places(
    size_m: Float[np.ndarray, "candidates 2"],
    rectangle_m: Float[np.ndarray, "candidates 4"],
    there_m: Float[np.ndarray, "objects 6"],
    draws: np.random.Generator,
) -> Float[Tensor, "candidates 2"]:
    """Random centres (x, z): flush with the rectangle, next to objects, or anywhere in it."""
    free = ((rectangle_m[:, 2:] - size_m) / 2).clip(min=0)
    middle = rectangle_m[:, :2]
    way = draws.random(size_m.shape)
    side = np.where(draws.random(size_m.shape) < 0.5, -1.0, 1.0)
    found = middle + free * (2 * draws.random(size_m.shape) - 1)
    found = np.where(way < FLUSH, middle + side * free, found)
    if len(there_m):
        # The same object along both axes, so that a piece can stand beside its one end.
        near = there_m[draws.integers(len(there_m), size=len(size_m))]
        own, theirs = size_m / 2, near[:, [3, 5]] / 2
        outside = draws.random(size_m.shape) < 0.5
        beside = near[:, [0, 2]] + side * np.where(outside, theirs + own, theirs - own)
        found = np.where((way >= FLUSH) & (way < FLUSH + ADJACENT), beside, found)
    return torch.from_numpy(found).float()

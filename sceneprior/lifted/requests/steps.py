"""One step of sequential Monte Carlo: place the next object of each particle where the request
allows it."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.core.boxes import QUARTERS
from sceneprior.core.mixtures import draw_index
from sceneprior.lifted.prototypes import turn_posed
from sceneprior.lifted.requests.particles import PARTICLES, Particles
from sceneprior.lifted.requests.relations import Furniture, furniture_in, furniture_of
from sceneprior.lifted.requests.rules import PlacementRules
from sceneprior.lifted.sampler.network import RoomSampler
from sceneprior.lifted.sampler.places import Places
from sceneprior.lifted.sampler.reading import Frame, Reading
from sceneprior.lifted.sampler.violations import settled, violation

TRIES = 4
"""Number of places drawn for an object in each particle; the first allowed one is taken."""
SIZE_RANGE = 0.35
"""Largest difference between the log extents of an object and of its look. The limit is tighter
than without a request: in a small room, the particles with the smallest objects survive."""

CANDIDATES = 128
"""Number of candidates, each a place and a rotation by quarter turns."""
COMPARED = 16
"""Largest number of allowed candidates whose densities are compared."""
FLUSH, ADJACENT = 0.5, 0.25
"""Probabilities, along each axis, that a candidate is flush with a side of a rectangle in the
floor, and that it is adjacent to an object or flush with it."""

Rejections = Counter[tuple[int, str]]
"""Number of places rejected for an object, by its class and the reason."""


class Proposal(NamedTuple):
    """The next objects of particles, and the distributions of their places."""

    rows: Int[Tensor, " some"]
    label: Int[Tensor, " some"]
    look: Int[Tensor, " some"]
    size_m: Float[Tensor, "some 3"]
    bottom_m: Float[Tensor, " some"]
    reading: Reading
    """Outputs of the sampler's encoder, in the frame of the rectangle in the floor that was drawn
    for each object."""
    places: Places


def place_next(
    sampler: RoomSampler,
    particles: Particles,
    rules: Sequence[PlacementRules],
    step: int,
    draws: Sequence[np.random.Generator],
    hanging: Sequence[int],
    rejections: Rejections,
) -> None:
    """Place the next object in all living particles; particles without a place die.

    Args:
        rules, draws: Placement rules and random numbers of each room.
        hanging: Indices of the classes that hang from a ceiling of known height.
        rejections: Counts to which rejected places are added.
    """
    chance = np.concatenate([each.random((PARTICLES, 6 + 4 * TRIES)) for each in draws])
    going = particles.alive & (particles.upcoming[:, step] != 0).numpy()
    rows = torch.from_numpy(np.flatnonzero(going))
    if not len(rows):
        return
    found = _propose(sampler, particles, rows, step, chance, hanging)
    waiting = _draw_places(sampler, particles, rules, found, step, chance, rejections)
    for at in waiting:
        row = int(found.rows[at])
        label = int(found.label[at])
        placed: tuple[int, Tensor] | str = "free floor"
        if particles.plan(row).required[step]:
            item = Unplaced(label, int(found.look[at]), found.size_m[at], float(found.bottom_m[at]))
            room = row // PARTICLES
            placed = search(
                sampler, found.reading.rows(torch.tensor([at])), item, rules[room],
                furniture_in(sampler, particles.rooms, row),
                particles.plan(row).upcoming[step + 1 :], draws[room],
            )  # fmt: skip
        if isinstance(placed, str):
            rejections[label, placed] += 1
            particles.alive[row] = False
        else:
            particles.place(row, label, *placed)


def _propose(
    sampler: RoomSampler,
    particles: Particles,
    rows: Int[Tensor, " some"],
    step: int,
    chance: Float[np.ndarray, "rows numbers"],
    hanging: Sequence[int],
) -> Proposal:
    """Draw the look, size and height of the next object of some particles."""
    label = particles.upcoming[rows, step]
    reading = particles.read(sampler, rows, step)
    numbers = torch.from_numpy(chance)[rows].float()
    look = draw_index(sampler.look_logits(reading, label), numbers[:, 0])
    off = sampler.extents(reading, label, look).draw(numbers[:, 1], numbers[:, 2:5])
    size_m = (sampler.look_shown[look, -3:] + off.clamp(-SIZE_RANGE, SIZE_RANGE)).exp()
    bottom_m = sampler.bottom_m(look, size_m)
    shapes = [particles.plan(row).shape for row in rows.tolist()]
    for at, shape in enumerate(shapes):
        if shape.ceiling_m is not None:
            highest_m = max(shape.ceiling_m - float(size_m[at, 1]), 0.0)
            hangs = int(label[at]) in hanging
            bottom_m[at] = highest_m if hangs else min(float(bottom_m[at]), highest_m)
    rectangle_m = torch.stack([
        torch.from_numpy(
            _rectangle(shape.floor.rectangles_m, size_m[at, ::2].numpy(), chance[row, 5])
        )
        for at, (row, shape) in enumerate(zip(rows.tolist(), shapes, strict=True))
    ]).float()  # fmt: skip
    reading = reading._replace(frame=Frame.plain(rectangle_m))
    places = sampler.place(reading, label, look, size_m, bottom_m)
    return Proposal(rows, label, look, size_m, bottom_m, reading, places)


def _rectangle(
    rectangles_m: Float[np.ndarray, "rectangles 4"], size_m: Float[np.ndarray, "2"], chance: float
) -> Float[np.ndarray, "4"]:
    """A random rectangle among those into which a footprint fits, in proportion to their areas."""
    fits = (rectangles_m[:, 2:] >= size_m).all(axis=1)
    if not fits.any():
        return rectangles_m[0]
    areas = rectangles_m[:, 2:].prod(axis=1) * fits
    return rectangles_m[np.searchsorted(areas.cumsum() / areas.sum(), chance, side="right")]


def _draw_places(
    sampler: RoomSampler,
    particles: Particles,
    rules: Sequence[PlacementRules],
    found: Proposal,
    step: int,
    chance: Float[np.ndarray, "rows numbers"],
    rejections: Rejections,
) -> list[int]:
    """Place each object at the first allowed place of `TRIES` drawn ones, and return the rows of
    `found` without one."""
    numbers = torch.from_numpy(chance[found.rows.numpy(), 6:]).float().unflatten(1, (TRIES, 4))
    x = found.places.draw_x(numbers[..., :2])
    waiting = torch.arange(len(found.rows))
    for number in range(TRIES):
        label, some = found.label[waiting], found.reading.rows(waiting)
        drawn = found.places.rows(waiting).draw(x[waiting, number], numbers[waiting, number, 2:])
        size_m = found.size_m[waiting]
        height_m = found.bottom_m[waiting] + size_m[:, 1] / 2
        boxes_m = torch.stack([drawn[:, 0], height_m, drawn[:, 1], *size_m.unbind(dim=1)], dim=1)
        apart = ~sampler.may_meet[label[:, None], some.before.object_class]
        boxes_m = settled(boxes_m, some, apart)
        free = violation(boxes_m, some, apart) == 0
        left = []
        for at, box_m, is_free, rectangle_m in zip(
            waiting.tolist(), boxes_m, free.tolist(), some.frame.rectangle_m, strict=True
        ):
            row, look = int(found.rows[at]), int(found.look[at])
            if is_free:
                one = slice(at, at + 1)
                candidates = furniture_of(sampler, box_m[None], found.label[one], found.look[one])
                allowed, reason = rules[row // PARTICLES].allowed(
                    int(found.label[at]), candidates,
                    furniture_in(sampler, particles.rooms, row),
                    particles.plan(row).upcoming[step + 1 :], rectangle_m[None].double().numpy(), 1,
                )  # fmt: skip
                if allowed[0]:
                    particles.place(row, int(found.label[at]), look, box_m)
                    continue
                rejections[int(found.label[at]), reason] += 1
            left.append(at)
        waiting = torch.tensor(left, dtype=torch.int64)
        if not left:
            break
    return waiting.tolist()


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
    rectangles_m = rules.shape.floor.rectangles_m
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

"""One step of sequential Monte Carlo: place the next object of each particle, that is, of each
partly furnished room."""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.core.mixtures import draw_index
from sceneprior.lifted.drawing.overlaps import resolve_overlap, violation
from sceneprior.lifted.drawing.plans import RoomPlans, read_rooms
from sceneprior.lifted.requests.relations import Furniture, furniture_of
from sceneprior.lifted.requests.rules import PlacementRules
from sceneprior.lifted.sampler.contents import END
from sceneprior.lifted.sampler.network import EncoderState, RoomSampler
from sceneprior.lifted.sampler.placement import DRAWS, Places

TRIES = 4
"""Places drawn for an object in each particle; the first allowed one is taken. With more, an object
whose likely places are taken would end up at an unlikely one."""
DENSE = 1
"""Places of these that are from the denser part of their distribution where rules reject places; a
room without rules draws all from it."""
NUMBERS = 3 + 4 * DRAWS * TRIES
"""Uniform random numbers of a particle in a step."""
LOOK_SHARPNESS, TWINS_SHARPNESS = 1.5, 3.0
"""Powers to which the probabilities of looks are raised, of a class's first object and of the next
ones, which mostly look alike; distributions learnt from a few hundred rooms are too broad."""
CANDIDATES = 128
"""Places in the whole room that are tried for a required object without a drawn place."""
COMPARED = 16
"""Largest number of allowed candidates whose densities are compared."""
FLUSH, ADJACENT = 0.5, 0.25
"""Probabilities, along each axis, that a candidate is flush with a side of a rectangle in the
floor, and that it is adjacent to an object or flush with it."""

Rejections = Counter[tuple[int, str]]
"""Number of places rejected for an object, by its class and the reason."""


class Particles:
    """Partly furnished rooms, one or several for each room; room r has `each` rows, the first of
    which is row r * `each`.

    Args:
        plans: The rooms' plans; all particles start with the given objects.
        each: Number of particles of a room.
    """

    rules: Sequence[PlacementRules] | None = None
    """Placement rules of each room, if the rooms have any."""

    def __init__(self, sampler: RoomSampler, plans: RoomPlans, each: int):
        self.sampler, self.plans, self.each = sampler, plans, each
        self.room = torch.arange(len(plans.shapes)).repeat_interleave(each)
        self.rooms = plans.rooms.changed(lambda part: part[self.room])
        assert self.rooms.looks is not None
        self.looks, self.offers = self.rooms.looks, sampler.offers()
        self.number = self.rooms.is_object.sum(dim=1)
        """Objects placed so far."""
        self.alive = torch.ones_like(self.number, dtype=torch.bool)
        """False for particles in which an object found no place, until they are replaced."""

    def furniture(self) -> list[Furniture]:
        """The objects of each particle."""
        most, rooms = int(self.number.max()), self.rooms
        parts = rooms.boxes_m, rooms.object_class, self.looks
        every = furniture_of(self.sampler, *(part[:, :most].flatten(0, 1) for part in parts))
        found = [
            every.rows(slice(row * most, row * most + number))
            for row, number in enumerate(self.number.tolist())
        ]
        own = self.plans.given_front
        for each in found:
            each.front[: len(own)] = np.where(np.isnan(own), each.front[: len(own)], own)
        return found

    def place(
        self,
        rows: Int[Tensor, " some"],
        label: Int[Tensor, " some"],
        look: Int[Tensor, " some"],
        boxes_m: Float[Tensor, "some 6"],
    ) -> None:
        """Add an object to each of some particles."""
        at = rows, self.number[rows]
        self.rooms.object_class[at], self.rooms.is_object[at] = label, True
        self.rooms.boxes_m[at], self.looks[at] = boxes_m, look
        self.number[rows] += 1

    def replace_dead(self, room: int, draws: np.random.Generator) -> None:
        """Replace each dead particle of a room by a copy of a random living one."""
        rows = torch.arange(room * self.each, (room + 1) * self.each)
        dead, living = rows[~self.alive[rows]], rows[self.alive[rows]]
        chosen = living[torch.from_numpy(draws.integers(len(living), size=len(dead)))]
        for part in (
            self.rooms.object_class, self.rooms.is_object, self.rooms.boxes_m, self.looks,
            self.number,
        ):  # fmt: skip
            part[dead] = part[chosen]
        self.alive[dead] = True


class Proposal(NamedTuple):
    """Next objects without a place, one in each of some particles."""

    sampler: RoomSampler
    label: Int[Tensor, " some"]
    look: Int[Tensor, " some"]
    size_m: Float[Tensor, "some 3"]
    bottom_m: Float[Tensor, " some"]
    state: EncoderState
    """Outputs of the encoder, with the rectangle in which each object is placed."""

    def rows(self, rows: Int[Tensor, " fewer"]) -> "Proposal":
        """Some of these objects."""
        return Proposal(
            self.sampler, self.label[rows], self.look[rows], self.size_m[rows],
            self.bottom_m[rows], self.state.rows(rows),
        )  # fmt: skip

    def boxes_m(self, place_m: Float[Tensor, "some 2"]) -> Float[Tensor, "some 6"]:
        """Boxes of the objects at places (x, z)."""
        height_m = self.bottom_m + self.size_m[:, 1] / 2
        centre_m = torch.stack([place_m[:, 0], height_m, place_m[:, 1]], dim=1)
        return torch.cat([centre_m, self.size_m], dim=1)

    def apart(self) -> Bool[Tensor, "some objects"]:
        """Objects of each room that the new object must not intersect."""
        return ~self.sampler.may_meet[self.label[:, None], self.state.before.object_class]

    def places(self) -> Places:
        """The distribution of the objects' places."""
        return self.sampler.place(self.state, self.label, self.look, self.size_m, self.bottom_m)


def place_next(
    particles: Particles,
    step: int,
    numbers: Float[Tensor, "rows numbers"],
    draws: Sequence[np.random.Generator],
    rejections: Rejections,
) -> None:
    """Place the next object in all living particles; particles without a place die.

    Args:
        numbers: `NUMBERS` uniform random numbers of each particle.
        draws: Random numbers of each room, for required objects that are searched a place.
        rejections: Counts to which rejected places are added.
    """
    going = particles.alive & (particles.plans.upcoming[particles.room, step] != END)
    rows = going.nonzero()[:, 0]
    if not len(rows):
        return
    now, numbers = _Step(particles, rows, step), numbers[rows]
    waiting, spare = torch.arange(len(rows)), dict[int, tuple[Tensor, Tensor]]()
    found = now.proposed(waiting, numbers[:, :3])
    for_x, for_z = numbers[:, 3:].unflatten(1, (2, TRIES, DRAWS, 2)).unbind(dim=1)
    dense = TRIES if particles.rules is None else DENSE
    x = (places := found.places()).draw_x(for_x, dense)
    for number in range(TRIES):
        own = found.rows(waiting)
        z_numbers = for_z[waiting, number]
        place_m = places.rows(waiting).draw(x[waiting, number], z_numbers, number < dense)
        boxes_m = own.boxes_m(place_m)
        boxes_m = resolve_overlap(boxes_m, own.state, own.apart())
        fits = violation(boxes_m, own.state, own.apart()) == 0
        if particles.rules is not None:
            free = fits.nonzero()[:, 0]
            candidates, rectangles_m = now.candidates(own.rows(free), boxes_m[free])
            for row, at in enumerate(free.tolist()):
                one = slice(row, row + 1)
                allowed, reason = now.allowed(
                    int(waiting[at]), candidates.rows(one), rectangles_m[one], 1
                )
                fits[at] = bool(allowed[0]) and now.is_sound(int(waiting[at]), candidates.rows(one))
                if not allowed[0]:
                    rejections[int(own.label[at]), reason] += 1
                elif not fits[at]:
                    spare.setdefault(int(waiting[at]), (own.look[at], boxes_m[at]))
        particles.place(rows[waiting[fits]], own.label[fits], own.look[fits], boxes_m[fits])
        waiting = waiting[~fits]
        if not len(waiting):
            return
    particles.alive[rows[waiting]] = False
    lost = ~particles.alive.unflatten(0, (-1, particles.each)).any(dim=1)
    required = particles.plans.required[now.room[waiting], step]
    for at in waiting[lost[now.room[waiting]] & required].tolist():
        room = int(now.room[at])
        if lost[room]:
            if reason := now.search(at, draws[room]):
                rejections[int(now.label[at]), reason] += 1
            else:
                particles.alive[rows[at]], lost[room] = True, False
    for at, (look, box_m) in spare.items():
        if lost[now.room[at]]:
            particles.place(rows[[at]], now.label[[at]], look[None], box_m[None])
            particles.alive[rows[at]] = True


class _Step:
    """The particles `rows` before an object of class `label` is placed in each of them."""

    def __init__(self, particles: Particles, rows: Int[Tensor, " some"], step: int):
        plans, sampler = particles.plans, particles.sampler
        self.particles, self.rows, self.room = particles, rows, particles.room[rows]
        self.upcoming = plans.upcoming[self.room, step:]
        self.label = self.upcoming[:, 0]
        before = particles.rooms.changed(lambda part: part[rows])
        self.state = read_rooms(
            sampler, before, particles.number[rows], plans.rectangle_m[self.room], self.upcoming
        )
        logits = sampler.look_logits(self.state, self.label, particles.offers)
        fewer = logits.masked_fill(sampler.excluded_looks(before), -torch.inf)
        self.logits = fewer.where(fewer.isfinite().any(dim=1, keepdim=True), logits)
        self._furniture = [] if particles.rules is None else particles.furniture()
        self._faults: dict[int, set[Any]] = {}

    def proposed(self, at: Int[Tensor, " some"], uniform: Float[Tensor, "some 3"]) -> Proposal:
        """Draw the look and the size of the next objects of some rows, and the rectangle in which
        each is placed, in proportion to the areas of those in which it fits."""
        sampler, plans = self.particles.sampler, self.particles.plans
        label, pieces_m, ceiling_m = self.label[at], plans.pieces_m[self.room[at]], plans.ceiling_m
        before = self.state.before.changed(lambda part: part[at])
        again = (before.is_object & (before.object_class == label[:, None])).any(dim=1)
        sharpness = torch.where(again, TWINS_SHARPNESS, LOOK_SHARPNESS).unsqueeze(1)
        look = draw_index(sharpness * self.logits[at], uniform[:, 0])
        size_m, bottom_m = sampler.draw_size(look, before, uniform[:, 1])
        if ceiling_m is not None:
            highest_m = (ceiling_m - size_m[:, 1]).clamp(min=0)
            lower_m = torch.minimum(bottom_m, highest_m)
            bottom_m = torch.where(plans.hangs[label], highest_m, lower_m)
        fits = (pieces_m[..., 2:] >= size_m[:, None, ::2]).all(dim=-1)
        areas_m2 = pieces_m[..., 2:].prod(dim=-1) * (fits | ~fits.any(dim=1, keepdim=True))
        chosen = draw_index(areas_m2.log(), uniform[:, 2])
        rectangle_m = pieces_m[torch.arange(len(label)), chosen]
        state = self.state.rows(at)._replace(rectangle_m=rectangle_m)
        return Proposal(sampler, label, look, size_m, bottom_m, state)

    def candidates(
        self, found: Proposal, boxes_m: Float[Tensor, "some 6"]
    ) -> tuple[Furniture, Float[np.ndarray, "some 4"]]:
        """Objects at places, and the rectangle of each, as the rules read them."""
        sampler = self.particles.sampler
        furniture = furniture_of(sampler, boxes_m, found.label, found.look)
        return furniture, found.state.rectangle_m.double().numpy()

    def allowed(
        self, at: int, candidates: Furniture, rectangles_m: Float[np.ndarray, "some 4"], enough: int
    ) -> tuple[Bool[np.ndarray, " some"], str]:
        """`PlacementRules.allowed` of places of the next object of row `at`."""
        if self.particles.rules is None:
            return np.ones(len(rectangles_m), dtype=bool), ""
        rules, later = self.particles.rules[int(self.room[at])], self.upcoming[at, 1:].tolist()
        return rules.allowed(
            int(self.label[at]), candidates, self._furniture[int(self.rows[at])], later,
            rectangles_m, enough,
        )  # fmt: skip

    def is_sound(self, at: int, candidate: Furniture) -> bool:
        """True if a place adds no fault to the room of row `at` (`PlacementRules.faults`)."""
        if self.particles.rules is None:
            return True
        rules = self.particles.rules[int(self.room[at])]
        placed = self._furniture[int(self.rows[at])]
        if at not in self._faults:
            self._faults[at] = rules.faults(placed)
        return rules.faults(placed.joined(candidate)) <= self._faults[at]

    def search(self, at: int, draws: np.random.Generator) -> str:
        """Place a required object anywhere in a room; the reason if there is no allowed place.

        Importance sampling: `CANDIDATES` with own looks and sizes are placed all over the room, and
        one of at most `COMPARED` allowed ones is drawn in proportion to the sampler's density.
        """
        particles, row = self.particles, self.rows[at]
        uniform = torch.from_numpy(draws.random((CANDIDATES, 3))).float()
        found = self.proposed(torch.full((CANDIDATES,), at), uniform)
        placed_m = particles.rooms.boxes_m[row, : particles.number[row]].numpy()
        rectangle_m = found.state.rectangle_m.numpy()
        place_m = _anywhere(found.size_m[:, ::2].numpy(), rectangle_m, placed_m, draws)
        boxes_m = found.boxes_m(place_m)
        free = (violation(boxes_m, found.state, found.apart()) == 0).nonzero()[:, 0]
        if not len(free):
            return "free floor"
        own = self.candidates(found.rows(free), boxes_m[free])
        allowed, reason = self.allowed(at, *own, COMPARED)
        fits = torch.from_numpy(allowed).nonzero()[:COMPARED, 0]
        if not len(fits):
            return reason
        sound = [row for row in fits.tolist() if self.is_sound(at, own[0].rows([row]))]
        fits = free[torch.tensor(sound) if sound else fits]
        density = found.rows(fits).places().log_prob(boxes_m[fits][:, [0, 2]])
        chosen = fits[draw_index(density[None], torch.tensor([draws.random()]).float())]
        particles.place(row[None], self.label[[at]], found.look[chosen], boxes_m[chosen])
        return ""


def _anywhere(
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

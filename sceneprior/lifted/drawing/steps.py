"""One step of sequential Monte Carlo: place the next object of each particle."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.core.mixtures import draw_index
from sceneprior.lifted.drawing.particles import Particles
from sceneprior.lifted.drawing.plans import BEYOND_M, RoomPlans
from sceneprior.lifted.requests.relations import Furniture, furniture_of
from sceneprior.lifted.requests.rules import PlacementRules
from sceneprior.lifted.sampler.encoder_state import EncoderState, Frame
from sceneprior.lifted.sampler.network import RoomSampler
from sceneprior.lifted.sampler.places import Places
from sceneprior.lifted.sampler.rooms import GRAZE_M, shared_extents

TRIES = 4
"""Places drawn for an object in each particle; the first allowed one is taken. With more, an object
whose likely places are taken would end up at an unlikely one."""
NUMBERS = 3 + 4 * TRIES
"""Uniform random numbers of a particle in a step."""
CANDIDATES = 128
"""Places in the whole room that are tried for a required object without a drawn place."""
COMPARED = 16
"""Largest number of allowed candidates whose densities are compared."""
FLUSH, ADJACENT = 0.5, 0.25
"""Probabilities, along each axis, that a candidate is flush with a side of a rectangle in the
floor, and that it is adjacent to an object or flush with it."""
INTERSECTING = 0.01
"""Shared volume, relative to the smaller box, above which two boxes count as intersecting; the same
as in the evaluation."""

Rejections = Counter[tuple[int, str]]
"""Number of places rejected for an object, by its class and the reason."""


class Proposal(NamedTuple):
    """Next objects without a place, one in each of some particles."""

    label: Int[Tensor, " some"]
    look: Int[Tensor, " some"]
    size_m: Float[Tensor, "some 3"]
    bottom_m: Float[Tensor, " some"]
    state: EncoderState
    """Outputs of the encoder, in the frame of the rectangle in which each object is placed."""

    def rows(self, rows: Int[Tensor, " fewer"]) -> "Proposal":
        """Some of these objects."""
        return Proposal(
            self.label[rows], self.look[rows], self.size_m[rows], self.bottom_m[rows],
            self.state.rows(rows),
        )  # fmt: skip

    def boxes_m(self, place_m: Float[Tensor, "some 2"]) -> Float[Tensor, "some 6"]:
        """Boxes of the objects at places (x, z)."""
        height_m = self.bottom_m + self.size_m[:, 1] / 2
        centre_m = torch.stack([place_m[:, 0], height_m, place_m[:, 1]], dim=1)
        return torch.cat([centre_m, self.size_m], dim=1)

    def apart(self, sampler: RoomSampler) -> Bool[Tensor, "some objects"]:
        """Objects of each room that the new object must not intersect."""
        return ~sampler.may_meet[self.label[:, None], self.state.before.object_class]

    def places(self, sampler: RoomSampler) -> Places:
        """The distribution of the objects' places."""
        return sampler.place(self.state, self.label, self.look, self.size_m, self.bottom_m)


def place_next(
    sampler: RoomSampler,
    particles: Particles,
    rules: Sequence[PlacementRules] | None,
    step: int,
    numbers: Float[Tensor, "rows numbers"],
    draws: Sequence[np.random.Generator],
    rejections: Rejections,
) -> None:
    """Place the next object in all living particles; particles without a place die.

    Args:
        rules: Placement rules of each room, if the rooms have any.
        numbers: `NUMBERS` uniform random numbers of each particle.
        draws: Random numbers of each room, for required objects that are searched a place.
        rejections: Counts to which rejected places are added.
    """
    plans = particles.plans
    going = particles.alive & (plans.upcoming[particles.room, step] != 0)
    rows = going.nonzero()[:, 0]
    if not len(rows):
        return
    room, numbers = particles.room[rows], numbers[rows]
    state = particles.read(sampler, rows, step)
    label = plans.upcoming[room, step]
    logits = sampler.look_logits(state, label)
    found = _proposed(sampler, state, label, logits, numbers[:, :3], plans, room)
    x = (places := found.places(sampler)).draw_x(numbers[:, 3:].unflatten(1, (TRIES, 4))[..., :2])
    checks = None if rules is None else _Checks(sampler, particles, rules, step)
    waiting = torch.arange(len(rows))
    for number in range(TRIES):
        own = found.rows(waiting)
        z_numbers = numbers[waiting, 5 + 4 * number : 7 + 4 * number]
        boxes_m = own.boxes_m(places.rows(waiting).draw(x[waiting, number], z_numbers))
        boxes_m = resolve_overlap(boxes_m, own.state, own.apart(sampler))
        fits = violation(boxes_m, own.state, own.apart(sampler)) == 0
        if checks is not None:
            free = fits.nonzero()[:, 0]
            allowed = checks.each(rows[waiting[free]], own.rows(free), boxes_m[free])
            for at, reason in zip(free.tolist(), allowed, strict=True):
                fits[at] = not reason
                if reason:
                    rejections[int(own.label[at]), reason] += 1
        particles.place(rows[waiting[fits]], own.label[fits], own.look[fits], boxes_m[fits])
        waiting = waiting[~fits]
        if not len(waiting):
            return
    particles.alive[rows[waiting]] = False
    lost = ~particles.alive.unflatten(0, (-1, particles.each)).any(dim=1)
    for at in waiting[lost[room[waiting]] & plans.required[room[waiting], step]].tolist():
        row = int(rows[at])
        one = state.rows(torch.tensor([at]))
        reason = _search(sampler, particles, checks, row, one, step, draws[int(room[at])])
        particles.alive[row] = not reason
        if reason:
            rejections[int(found.label[at]), reason] += 1


class _Checks:
    """The rules of all rooms, applied to places of their next objects."""

    def __init__(
        self,
        sampler: RoomSampler,
        particles: Particles,
        rules: Sequence[PlacementRules],
        step: int,
    ):
        self._sampler, self._particles, self._rules, self._step = sampler, particles, rules, step
        most, rooms = int(particles.number.max()), particles.rooms
        flat = (part[:, :most].flatten(0, 1) for part in (
            rooms.boxes_m, rooms.object_class, particles.looks
        ))  # fmt: skip
        self._placed, self._most = furniture_of(sampler, *flat), most
        self._number = particles.number.tolist()

    def allowed(
        self, row: int, candidates: Furniture, rectangle_m: Float[np.ndarray, "some 4"], enough: int
    ) -> tuple[Bool[np.ndarray, " candidates"], str]:
        """`PlacementRules.allowed` of places in a particle."""
        room, start = int(self._particles.room[row]), row * self._most
        placed = self._placed.rows(slice(start, start + self._number[row]))
        upcoming = self._particles.plans.upcoming[room, self._step + 1 :].tolist()
        label = int(candidates.object_class[0])
        return self._rules[room].allowed(label, candidates, placed, upcoming, rectangle_m, enough)

    def each(
        self, rows: Int[Tensor, " some"], found: Proposal, boxes_m: Float[Tensor, "some 6"]
    ) -> list[str]:
        """The reason why the object of each particle may not take its place; empty if it may."""
        candidates = furniture_of(self._sampler, boxes_m, found.label, found.look)
        rectangle_m = found.state.frame.rectangle_m.double().numpy()
        reasons = []
        for at, row in enumerate(rows.tolist()):
            one = slice(at, at + 1)
            allowed, reason = self.allowed(row, candidates.rows(one), rectangle_m[one], 1)
            reasons.append("" if allowed[0] else reason)
        return reasons


def _proposed(
    sampler: RoomSampler,
    state: EncoderState,
    label: Int[Tensor, " some"],
    logits: Float[Tensor, "#some looks"],
    uniform: Float[Tensor, "some 3"],
    plans: RoomPlans,
    room: Int[Tensor, " some"],
) -> Proposal:
    """Draw the look and the size of objects, and the rectangle in which each is placed, in
    proportion to the areas of those in which it fits."""
    pieces_m, ceiling_m = plans.pieces_m[room], plans.ceiling_m
    look = draw_index(logits, uniform[:, 0])
    size_m = sampler.draw_size(look, uniform[:, 1])
    bottom_m = sampler.bottom_m(look, size_m)
    if ceiling_m is not None:
        highest_m = (ceiling_m - size_m[:, 1]).clamp(min=0)
        bottom_m = torch.where(plans.hangs[label], highest_m, torch.minimum(bottom_m, highest_m))
    fits = (pieces_m[..., 2:] >= size_m[:, None, ::2]).all(dim=-1)
    areas_m2 = pieces_m[..., 2:].prod(dim=-1) * (fits | ~fits.any(dim=1, keepdim=True))
    chosen = draw_index(areas_m2.log(), uniform[:, 2])
    rectangle_m = pieces_m[torch.arange(len(label)), chosen]
    return Proposal(label, look, size_m, bottom_m, state._replace(frame=Frame.plain(rectangle_m)))


def _search(
    sampler: RoomSampler,
    particles: Particles,
    checks: _Checks | None,
    row: int,
    state: EncoderState,
    step: int,
    draws: np.random.Generator,
) -> str:
    """Place a required object anywhere in the room; the reason if there is no allowed place.

    Importance sampling: `CANDIDATES` with own looks and sizes are placed all over the room, and one
    of at most `COMPARED` allowed ones is drawn in proportion to the sampler's density.
    """
    plans, room = particles.plans, int(particles.room[row])
    label = plans.upcoming[room, step].expand(CANDIDATES)
    many = state.rows(torch.zeros(CANDIDATES, dtype=torch.int64))
    uniform = torch.from_numpy(draws.random((CANDIDATES, 3))).float()
    logits = sampler.look_logits(state, label[:1])
    found = _proposed(sampler, many, label, logits, uniform, plans, torch.full((CANDIDATES,), room))
    placed_m = particles.rooms.boxes_m[row, : particles.number[row]].numpy()
    place_m = _anywhere(
        found.size_m[:, ::2].numpy(), found.state.frame.rectangle_m.numpy(), placed_m, draws
    )
    boxes_m = found.boxes_m(place_m)
    free = (violation(boxes_m, found.state, found.apart(sampler)) == 0).nonzero()[:, 0]
    if not len(free):
        return "free floor"
    if checks is not None:
        some = found.rows(free)
        candidates = furniture_of(sampler, boxes_m[free], some.label, some.look)
        rectangle_m = some.state.frame.rectangle_m.double().numpy()
        allowed, reason = checks.allowed(row, candidates, rectangle_m, COMPARED)
        free = free[torch.from_numpy(allowed)]
        if not len(free):
            return reason
    fits = free[:COMPARED]
    density = found.rows(fits).places(sampler).log_prob(boxes_m[fits][:, [0, 2]])
    chosen = fits[draw_index(density[None], torch.tensor([draws.random()]).float())]
    particles.place(torch.tensor([row]), label[:1], found.look[chosen], boxes_m[chosen])
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


def resolve_overlap(
    boxes_m: Float[Tensor, "rooms 6"], state: EncoderState, apart: Bool[Tensor, "rooms objects"]
) -> Float[Tensor, "rooms 6"]:
    """Move boxes out of objects marked in `apart`, and into the rectangle, along each axis by at
    most `GRAZE_M`, because sampled places are not accurate to the centimetre."""
    others_m = state.before.boxes_m
    shared = shared_extents(boxes_m.unsqueeze(1), others_m)
    grazes = apart & state.before.is_object & (shared > 0).all(dim=-1)
    x_and_z, away = shared[..., ::2], (boxes_m.unsqueeze(1) - others_m)[..., [0, 2]]
    least = x_and_z == x_and_z.amin(dim=-1, keepdim=True)
    moves = x_and_z * away.sign() * (least & (x_and_z <= GRAZE_M) & grazes.unsqueeze(-1))
    centre = boxes_m[:, [0, 2]] + moves.sum(dim=1)
    middle, extents = state.frame.rectangle_m.split(2, dim=-1)
    free = ((extents - boxes_m[:, [3, 5]]) / 2).clamp(min=0)
    inside = centre.clamp(middle - free, middle + free)
    centre = inside.where((inside - centre).abs() <= GRAZE_M, centre)
    moved = boxes_m.clone()
    moved[:, [0, 2]] = centre
    return moved


def violation(
    boxes_m: Float[Tensor, "rooms 6"], state: EncoderState, apart: Bool[Tensor, "rooms objects"]
) -> Float[Tensor, " rooms"]:
    """Violation of a box; 0 if there is none.

    The violation is the sum of two terms: the shared volumes with objects marked in `apart`, each
    relative to the smaller box, and the metres by which the box extends beyond the rectangle.
    """
    others = state.before
    here, theirs = boxes_m.unsqueeze(1), others.boxes_m
    shared = shared_extents(here, theirs).prod(dim=-1)
    least = torch.minimum(here[..., 3:].prod(dim=-1), theirs[..., 3:].prod(dim=-1))
    share = shared / least.clamp(min=1e-9)
    share = share.where((share > INTERSECTING) & others.is_object & apart, 0.0)
    middle, extents = state.frame.rectangle_m.split(2, dim=-1)
    beyond = (boxes_m[:, [0, 2]] - middle).abs() + (boxes_m[:, [3, 5]] - extents) / 2
    return share.sum(dim=-1) + (beyond.amax(dim=-1) - BEYOND_M).clamp(min=0)

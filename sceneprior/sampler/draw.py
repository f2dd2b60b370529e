"""Draw rooms from a trained sampler: from nothing, or round objects that are given."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.sampler.mixtures import draw_index
from sceneprior.sampler.network import END, Reading, RoomSampler
from sceneprior.sampler.rooms import rectangle_sides, rectangles_of, shared_extents
from sceneprior.views import RoomBoxes

PLACES = 32
"""Places drawn for an object, which takes the first at which nothing is wrong."""
RECTANGLES = 16
"""Rectangles drawn for a room, which takes the first that holds what is given."""
LOOKS = 16
"""Looks drawn for a given object, which takes one by how well its place fits."""
INTERSECTING = 0.01
"""Two boxes intersect from this share of the smaller one's volume on, as scores have it."""
BEYOND_M = 0.01
"""An object may stick out of the rectangle this far."""
SIZE_RANGE = 0.5
"""An object's extents differ from its look's by this factor's logarithm at most."""
SIZE_DOUBT = 0.1
"""The same of a given object, as a standard deviation."""
ROUNDS = 8
"""Times that a room is begun, at most."""
BATCH = 256
"""Rooms drawn at a time."""


@dataclass(frozen=True)
class Given:
    """What rooms are drawn round; there are as many rooms as are drawn."""

    objects: RoomBoxes
    """What stands there already; looks need not be known."""
    rectangle_m: Float[Tensor, "rooms 4"] | None = None
    """What furniture may fill: centre x, z and extents x, z. None draws it."""
    coming: Int[Tensor, "rooms wanted"] | None = None
    """Classes of the objects to add, and of no others, in this order; `END` for none. None leaves
    it to the sampler."""

    def rows(self, rows: Int[Tensor, " some"]) -> "Given":
        """Of some rooms."""
        rest = (None if each is None else each[rows] for each in (self.rectangle_m, self.coming))
        return Given(self.objects.changed(lambda each: each[rows]), *rest)


def nothing_given(rooms: int) -> Given:
    """To draw whole rooms."""
    none = torch.zeros(rooms, 0, dtype=torch.int64)
    return Given(RoomBoxes(none, none > 0, torch.zeros(rooms, 0, 6)))


@torch.no_grad()
def draw_rooms(
    sampler: RoomSampler, count: int, seed: int, given: Given | None = None
) -> RoomBoxes:
    """Rooms with looks; given objects come first, with the boxes that they came with.

    A room in which some object finds no place, of `PLACES`, at which it neither intersects what it
    should not (`RoomSampler.may_meet`) nor sticks out of the rectangle is begun again, `ROUNDS`
    times at most; in the last, such objects are left out. Objects whose classes were asked for are
    never left out: there, they take the place with least wrong.

    The same seed draws the same rooms, the first of them however many follow.
    """
    given = given or nothing_given(count)
    drawn = _nothing_drawn(count, sampler.max_objects)
    waiting = torch.arange(count)
    for number in range(ROUNDS):
        last = number + 1 == ROUNDS
        numbers = _numbers(sampler, count, seed, number)
        stuck = []
        for rows in waiting.split(BATCH):
            found, found_stuck = _draw(sampler, numbers[rows], given.rows(rows), last)
            for whole, part in zip(_parts(drawn), _parts(found), strict=True):
                whole[rows] = part
            stuck.append(rows[found_stuck])
        waiting = torch.cat(stuck)
        if last or not len(waiting):
            break
    return drawn


def _numbers(
    sampler: RoomSampler, count: int, seed: int, number: int
) -> Float[Tensor, "rooms numbers"]:
    """Uniform numbers of all rooms for one round, drawn in one call: what a room gets does not
    depend on how many there are."""
    (state,) = np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)
    generator = torch.Generator().manual_seed(int(state >> np.uint64(1)))
    each = 2 * sampler.max_objects * (7 + 3 * PLACES) + 5 * RECTANGLES
    return torch.rand(count, each, generator=generator)


def _nothing_drawn(count: int, slots: int) -> RoomBoxes:
    none = torch.zeros(count, slots, dtype=torch.int64)
    return RoomBoxes(none, none > 0, torch.zeros(count, slots, 6), looks=none.clone())


def _parts(rooms: RoomBoxes) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    assert rooms.looks is not None
    return rooms.object_class, rooms.is_object, rooms.boxes_m, rooms.looks


def _holding(tried: Float[Tensor, "rooms tries 4"], objects: RoomBoxes) -> Float[Tensor, "rooms 4"]:
    """The first rectangle that holds the given objects; if none does, the first, grown to."""
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


def _draw(
    sampler: RoomSampler, numbers: Float[Tensor, "rooms numbers"], given: Given, last: bool
) -> tuple[RoomBoxes, Bool[Tensor, " rooms"]]:
    """Rooms, and those in which some object found no place."""
    frames, uniform = numbers.split([5 * RECTANGLES, numbers.shape[1] - 5 * RECTANGLES], dim=1)
    uniform = uniform.unflatten(1, (-1, 7 + 3 * PLACES))
    rectangle_m = given.rectangle_m
    if rectangle_m is None:
        choice, *normal = frames.unflatten(1, (RECTANGLES, 5)).unbind(dim=-1)
        noise = torch.special.ndtri(torch.stack(normal, dim=-1).clamp(1e-6, 1 - 1e-6))
        rectangle_m = _holding(sampler.rectangles(choice, noise), given.objects)
    slots, number = sampler.max_objects, given.objects.is_object.sum(dim=1)
    rooms = _recognised(sampler, uniform, rectangle_m, given.objects)
    looks = rooms.looks
    assert looks is not None
    wanted = given.coming
    going = number < slots
    added, stuck = torch.zeros_like(number), torch.zeros_like(going)
    for chance in uniform.unbind(dim=1):
        reading = _read(sampler, rooms, number, rectangle_m)
        if wanted is None:
            label = draw_index(sampler.class_logits(reading), chance[:, 0])
        else:
            label = F.pad(wanted, (0, slots)).gather(1, added[:, None])[:, 0]
        going = going & (label != END) & (number < slots)
        if not going.any():
            break
        some = label.where(going, label[going][0])  # rooms that have ended go along
        look, tried_m = _tried(sampler, reading, some, chance)
        wrong = _wrong(tried_m, some, reading, sampler.may_meet)
        best = wrong.argmin(dim=1, keepdim=True)  # the first of equal ones
        fits = wrong.gather(1, best)[:, 0] == 0
        stuck = stuck | (going & ~fits)
        # A room that is begun again needs no end.
        placed = going & fits if wanted is None or not last else going
        going = going & (fits | last)
        box_m = torch.take_along_dim(tried_m, best.unsqueeze(-1), dim=1)[:, 0]
        at = (placed.nonzero()[:, 0], number[placed])
        rooms.object_class[at], rooms.is_object[at] = some[placed], True
        rooms.boxes_m[at], looks[at] = box_m[placed], look[placed]
        number, added = number + placed, added + placed
    return rooms, stuck


def _read(
    sampler: RoomSampler,
    rooms: RoomBoxes,
    number: Int[Tensor, " rooms"],
    rectangle_m: Float[Tensor, "rooms 4"],
) -> Reading:
    """Read the first so many objects of each room."""
    most = int(number.max())
    first = torch.arange(most, device=number.device) < number[:, None]
    before = rooms.changed(lambda part: part[:, :most]).only(first)
    return sampler.read(before, rectangle_m, sampler.tokens(before, rectangle_m))


def _tried(
    sampler: RoomSampler,
    reading: Reading,
    label: Int[Tensor, " rooms"],
    chance: Float[Tensor, "rooms numbers"],
) -> tuple[Int[Tensor, " rooms"], Float[Tensor, "rooms places 6"]]:
    """A look and a size for an object of a class, and boxes at all places tried."""
    look = draw_index(sampler.look_logits(reading, label), chance[:, 1])
    details = sampler.details(reading, label, look).draw(chance[:, 2], chance[:, 3:7])
    off = details[:, :3].clamp(-SIZE_RANGE, SIZE_RANGE)
    size_m = (sampler.look_shown[look, -3:] + off).exp()
    bottom_m = details[:, 3].clamp(min=0)  # the floor
    places = sampler.place(reading, label, look, size_m, bottom_m)
    numbers = chance[:, 7:].unflatten(1, (PLACES, 3))
    x, z = places.drawn(numbers[..., 0], numbers[..., 1:]).unbind(dim=-1)
    y = (bottom_m + size_m[:, 1] / 2).unsqueeze(1).expand_as(x)
    size_m = size_m.unsqueeze(1).expand(-1, PLACES, -1)
    return look, torch.cat([torch.stack([x, y, z], dim=-1), size_m], dim=-1)


def _recognised(
    sampler: RoomSampler,
    uniform: Float[Tensor, "rooms attempts numbers"],
    rectangle_m: Float[Tensor, "rooms 4"],
    objects: RoomBoxes,
) -> RoomBoxes:
    """The given objects in as many slots as rooms have, each with a look: drawn by how likely that
    and the size are, and again by how likely the place is then."""
    count, known = objects.is_object.shape
    empty = (0, sampler.max_objects - known)
    looks = torch.zeros(count, sampler.max_objects, dtype=torch.int64)
    rooms = RoomBoxes(
        F.pad(objects.object_class, empty), F.pad(objects.is_object, empty),
        F.pad(objects.boxes_m, (0, 0, *empty)), looks=looks,
    )  # fmt: skip
    for step in range(known):
        here = rooms.is_object[:, step]
        reading = _read(sampler, rooms, torch.full((count,), step), rectangle_m)
        label = rooms.object_class[:, step].clamp(min=1)
        centre_m, size_m = rooms.boxes_m[:, step].split(3, dim=-1)
        size_m = size_m.where(here[:, None], 1.0)
        off = size_m.log().unsqueeze(1) - sampler.look_shown[:, -3:]
        logits = sampler.look_logits(reading, label)
        logits = logits - off.square().sum(dim=-1) / (2 * SIZE_DOUBT**2)
        chance = uniform[:, step]
        some = draw_index(logits.unsqueeze(1).expand(-1, LOOKS, -1), chance[:, 1 : 1 + LOOKS])
        bottom_m = centre_m[:, 1] - size_m[:, 1] / 2
        fits = [
            sampler.place(reading, label, look, size_m, bottom_m).log_prob(centre_m[:, ::2])
            for look in some.unbind(dim=1)
        ]
        chosen = draw_index(torch.stack(fits, dim=1), chance[:, 0])
        looks[:, step] = some.gather(1, chosen[:, None])[:, 0] * here
    return rooms


def _wrong(
    boxes_m: Float[Tensor, "rooms places 6"],
    label: Int[Tensor, " rooms"],
    reading: Reading,
    may_meet: Bool[Tensor, "classes classes"],
) -> Float[Tensor, "rooms places"]:
    """What is wrong with a box at a place: the shares of smaller boxes in which it intersects what
    it should not, and by how many metres it sticks out; 0 where nothing is."""
    others = reading.before
    here, theirs = boxes_m.unsqueeze(2), others.boxes_m.unsqueeze(1)
    shared = shared_extents(here, theirs).prod(dim=-1)
    least = torch.minimum(here[..., 3:].prod(dim=-1), theirs[..., 3:].prod(dim=-1))
    share = shared / least.clamp(min=1e-9)
    counts = others.is_object & ~may_meet[label[:, None], others.object_class]
    share = share.where((share > INTERSECTING) & counts.unsqueeze(1), 0.0)
    middle, extents = reading.rectangle_m.unsqueeze(1).split(2, dim=-1)
    beyond = (boxes_m[..., [0, 2]] - middle).abs() + (boxes_m[..., [3, 5]] - extents) / 2
    return share.sum(dim=-1) + (beyond.amax(dim=-1) - BEYOND_M).clamp(min=0)

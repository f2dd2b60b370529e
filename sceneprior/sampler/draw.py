"""Draw rooms from a trained sampler: from nothing, or round objects that are given."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.sampler.contents import END
from sceneprior.sampler.mixtures import draw_index
from sceneprior.sampler.network import Frame, Reading, RoomSampler
from sceneprior.sampler.plan import (
    BEYOND_M,
    Given,
    Plan,
    nothing_given,
    plan_rooms,
    uniform_numbers,
)
from sceneprior.sampler.rooms import FRAME_M, rectangle_sides, rectangles_of, shared_extents
from sceneprior.views import RoomBoxes

PLACES = 32
"""Places drawn for an object, which takes the first at which nothing is wrong."""
LOOKS = 16
"""Looks drawn for a given object, which takes one by how well its place fits."""
INTERSECTING = 0.01
"""Two boxes intersect from this share of the smaller one's volume on, as scores have it."""
OPEN_M = 3 * FRAME_M
"""Of 370 sides of training rooms' rectangles one lies further from the furniture."""
SIZE_RANGE = 0.5
"""An object's extents differ from its look's by this factor's logarithm at most."""
SIZE_DOUBT = 0.1
"""The same of a given object, as a standard deviation."""
ROUNDS = 8
"""Times that a room is furnished, at most, before it is planned anew."""
PLANS = 3
"""Times that a room is planned, at most."""
BATCH = 256
"""Rooms drawn at a time."""


@torch.no_grad()
def draw_rooms(
    sampler: RoomSampler, count: int, seed: int, given: Given | None = None
) -> RoomBoxes:
    """Rooms with looks; given objects come first, with the boxes that they came with.

    What a room holds is drawn first. A room in which some object then finds no place, of `PLACES`,
    at which it neither intersects what it should not (`RoomSampler.may_meet`) nor sticks out of the
    rectangle is furnished again, and after `ROUNDS` planned again; in the last round of `PLANS`,
    such objects are left out. Objects whose classes were asked for are never left out: there, they
    take the place with least wrong. Furnished again is also what leaves a side of a drawn rectangle
    open (`OPEN_M`), as no training room does.

    The same seed draws the same rooms, the first of them however many follow.
    """
    given = given or nothing_given(count)
    keep = given.coming is not None
    slots, waiting = sampler.max_objects, torch.arange(count)
    drawn = _nothing_drawn(count, slots)
    for number in range(PLANS * ROUNDS):
        last = number + 1 == PLANS * ROUNDS
        if number % ROUNDS == 0:
            plan = plan_rooms(sampler, given, count, (seed, number // ROUNDS))
        numbers = uniform_numbers(count, slots * (7 + 3 * PLACES), (seed, PLANS + number))
        numbers = numbers.unflatten(1, (slots, -1))
        stuck = []
        for rows in waiting.split(BATCH):
            found, found_stuck = _draw(sampler, numbers[rows], plan.rows(rows), last, keep)
            for whole, part in zip(_parts(drawn), _parts(found), strict=True):
                whole[rows] = part
            stuck.append(rows[found_stuck])
        waiting = torch.cat(stuck)
        if last or not len(waiting):
            break
    return drawn


def _nothing_drawn(count: int, slots: int) -> RoomBoxes:
    none = torch.zeros(count, slots, dtype=torch.int64)
    return RoomBoxes(none, none > 0, torch.zeros(count, slots, 6), looks=none.clone())


def _parts(rooms: RoomBoxes) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    assert rooms.looks is not None
    return rooms.object_class, rooms.is_object, rooms.boxes_m, rooms.looks


def _draw(
    sampler: RoomSampler,
    uniform: Float[Tensor, "rooms slots numbers"],
    plan: Plan,
    last: bool,
    keep: bool,
) -> tuple[RoomBoxes, Bool[Tensor, " rooms"]]:
    """Rooms, and those in which some object found no place; `keep` places it all the same."""
    number = plan.objects.is_object.sum(dim=1)
    rooms = _recognised(sampler, uniform, plan)
    looks = rooms.looks
    assert looks is not None
    stuck = torch.zeros_like(number, dtype=torch.bool)
    added = (plan.coming != END).any(dim=1)
    for step, chance in enumerate(uniform.unbind(dim=1)):
        label = plan.coming[:, step]
        # A room that is furnished again needs no end.
        going = (label != END) & (last | ~stuck)
        if not going.any():
            break
        reading = _read(sampler, rooms, number, plan, plan.coming[:, step:])
        some = label.where(going, label[going][0])  # rooms that have ended go along
        look, tried_m = _tried(sampler, reading, some, chance)
        wrong = _wrong(tried_m, some, reading, sampler.may_meet)
        best = wrong.argmin(dim=1, keepdim=True)  # the first of equal ones
        fits = wrong.gather(1, best)[:, 0] == 0
        stuck = stuck | (going & ~fits)
        placed = going & (fits | (last & keep))
        box_m = torch.take_along_dim(tried_m, best.unsqueeze(-1), dim=1)[:, 0]
        at = (placed.nonzero()[:, 0], number[placed])
        rooms.object_class[at], rooms.is_object[at] = some[placed], True
        rooms.boxes_m[at], looks[at] = box_m[placed], look[placed]
        number = number + placed
    return rooms, stuck | (added & plan.drawn & (_open_m(rooms, plan.rectangle_m) > OPEN_M))


def _open_m(rooms: RoomBoxes, rectangle_m: Float[Tensor, "rooms 4"]) -> Float[Tensor, " rooms"]:
    """How far the furniture stays away from the side that it is farthest from."""
    low, high = rectangle_sides(rectangle_m)
    own_low, own_high = rectangle_sides(rectangles_of(rooms))
    return torch.cat([own_low - low, high - own_high], dim=-1).amax(dim=-1)


def _read(
    sampler: RoomSampler,
    rooms: RoomBoxes,
    number: Int[Tensor, " rooms"],
    plan: Plan,
    coming: Int[Tensor, "rooms wanted"],
) -> Reading:
    """Read the first so many objects of each room, and what is to come."""
    most = int(number.max())
    first = torch.arange(most, device=number.device) < number[:, None]
    before = rooms.changed(lambda part: part[:, :most]).only(first)
    still = sampler.contents.before(coming, coming != END)[:, -1]
    tokens = sampler.tokens(before, plan.rectangle_m)
    return sampler.read(before, still, Frame.plain(plan.rectangle_m), tokens)


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
    uniform: Float[Tensor, "rooms slots numbers"],
    plan: Plan,
) -> RoomBoxes:
    """The given objects in as many slots as rooms have, each with a look: drawn by how likely that
    and the size are, and again by how likely the place is then."""
    objects = plan.objects
    count, known = objects.is_object.shape
    still = torch.cat([objects.object_class * objects.is_object, plan.coming], dim=1)
    empty = (0, sampler.max_objects - known)
    looks = torch.zeros(count, sampler.max_objects, dtype=torch.int64)
    rooms = RoomBoxes(
        F.pad(objects.object_class, empty), F.pad(objects.is_object, empty),
        F.pad(objects.boxes_m, (0, 0, *empty)), looks=looks,
    )  # fmt: skip
    for step in range(known):
        here = rooms.is_object[:, step]
        reading = _read(sampler, rooms, torch.full((count,), step), plan, still[:, step:])
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
    middle, extents = reading.frame.rectangle_m.unsqueeze(1).split(2, dim=-1)
    beyond = (boxes_m[..., [0, 2]] - middle).abs() + (boxes_m[..., [3, 5]] - extents) / 2
    return share.sum(dim=-1) + (beyond.amax(dim=-1) - BEYOND_M).clamp(min=0)

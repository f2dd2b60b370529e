"""Draw rooms from a trained sampler: whole rooms, or the rest of rooms with given objects."""

from dataclasses import replace
from operator import itemgetter

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.core.mixtures import draw_index
from sceneprior.lifted.rooms import PosedRooms
from sceneprior.lifted.sampler.contents import END
from sceneprior.lifted.sampler.network import RoomSampler
from sceneprior.lifted.sampler.plan import (
    Given,
    Plan,
    nothing_given,
    plan_rooms,
    uniform_numbers,
)
from sceneprior.lifted.sampler.reading import Frame, Reading
from sceneprior.lifted.sampler.rooms import FRAME_M, gaps_m
from sceneprior.lifted.sampler.violations import settled, violation

PLACES = 16
"""Places sampled for an object in the last attempt, in which it takes the best one."""
TRIES = 4
"""Places sampled for an object in each earlier attempt, of which it takes the first one without a
violation. With more places, an object whose likely places are taken would end up at an unlikely
one; instead, the room is furnished again."""
LOOKS = 16
"""Looks sampled for a given object, one of which is chosen by the likelihood of its place."""
OPEN_M = 3 * FRAME_M
"""Distance in metres beyond which a side counts as empty: 1 of 370 sides in the training rooms
exceeds it."""
SIZE_DOUBT = 0.1
"""Standard deviation of the difference between the log extents of a given object and of its
look."""
ROUNDS = 16
"""Maximum number of attempts to furnish a room before it is planned anew."""
PLANS = 3
"""Maximum number of plans of a room."""
BATCH = 512
"""Number of rooms sampled at a time."""
SIDE_BY_SIDE = 32
"""Number of attempts made at a time, if fewer rooms are left."""


@torch.no_grad()
def draw_rooms(
    sampler: RoomSampler, count: int, seed: int, given: Given | None = None
) -> PosedRooms:
    """Sample new rooms with looks and rectangles; given objects come first, with their own boxes.

    A room's contents are sampled first (`plan_rooms`), then its objects one by one, each at the
    first of `TRIES` sampled places where it neither intersects an object that it should not
    (`RoomSampler.may_meet`) nor extends beyond the rectangle. A room is furnished again if some
    object has no such place, or if a side of its sampled rectangle stays empty (`OPEN_M`), which is
    rare in training rooms. After `ROUNDS` attempts, the room is planned again.

    In the last attempt, `PLACES` places are sampled, and objects without a place are left out, also
    requested ones.

    The same seed draws the same rooms, and the first ones do not depend on `count`.
    """
    given = given or nothing_given(count)
    slots, waiting = sampler.max_objects, torch.arange(count)
    drawn, rectangle_m = _nothing_drawn(count, slots), torch.zeros(count, 4)
    number, last = 0, PLANS * ROUNDS - 1
    while len(waiting) and number <= last:
        if number % ROUNDS == 0:
            plan = plan_rooms(sampler, given, count, (seed, number // ROUNDS))
        # The very last attempt is by itself, because it places objects in another way.
        until = min(number + _attempts(len(waiting)), ROUNDS * (number // ROUNDS + 1), last)
        attempts = range(number, max(until, number + 1))
        each = (count, slots * (3 + 4 * PLACES))
        numbers = torch.stack([uniform_numbers(*each, (seed, PLANS + at)) for at in attempts])
        numbers = numbers.unflatten(2, (slots, -1))
        rectangle_m[waiting] = plan.rectangle_m[waiting]
        stuck = []
        for rows in waiting.split(BATCH):
            again = rows.repeat(len(attempts))
            chance = numbers[:, rows].flatten(0, 1)
            found, found_stuck = _draw(sampler, chance, plan.rows(again), number == last)
            by_attempt = found_stuck.unflatten(0, (len(attempts), -1))
            chosen = by_attempt.int().argmin(dim=0) * len(rows) + torch.arange(len(rows))
            for whole, part in zip(_parts(drawn), _parts(found), strict=True):
                whole[rows] = part[chosen]
            stuck.append(rows[by_attempt.all(dim=0)])
        waiting, number = torch.cat(stuck), attempts.stop
    return replace(drawn, rectangle_m=rectangle_m)


def _attempts(rooms: int) -> int:
    """Number of attempts that are made side by side for each of these rooms, of which the first
    successful one counts. One after another, the attempts for a few last rooms would take most of
    the time: a step takes about as long for one room as for `SIDE_BY_SIDE`."""
    return max(1, SIDE_BY_SIDE // rooms)


def _nothing_drawn(count: int, slots: int) -> PosedRooms:
    none = torch.zeros(count, slots, dtype=torch.int64)
    return PosedRooms(none, none > 0, torch.zeros(count, slots, 6), looks=none.clone())


def _parts(rooms: PosedRooms) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    assert rooms.looks is not None
    return rooms.object_class, rooms.is_object, rooms.boxes_m, rooms.looks


def _draw(
    sampler: RoomSampler,
    uniform: Float[Tensor, "rooms slots numbers"],
    plan: Plan,
    last: bool,
) -> tuple[PosedRooms, Bool[Tensor, " rooms"]]:
    """Furnish rooms once; also return a mask of the rooms to furnish again, because some object
    found no place, or a side of a sampled rectangle stays empty.
    """
    number = plan.objects.is_object.sum(dim=1)
    rooms = with_looks(sampler, uniform, plan)
    looks = rooms.looks
    assert looks is not None
    stuck = torch.zeros_like(number, dtype=torch.bool)
    added = (plan.coming != END).any(dim=1)
    for step, chance in enumerate(uniform.unbind(dim=1)):
        # Rooms to be furnished again are not completed.
        rows = ((plan.coming[:, step] != END) & (last | ~stuck)).nonzero()[:, 0]
        if not len(rows):
            break
        label, begun = plan.coming[rows, step], rooms.changed(itemgetter(rows))
        coming, rectangle_m = plan.coming[rows, step:], plan.rectangle_m[rows]
        reading = read_rooms(sampler, begun, number[rows], rectangle_m, coming)
        tries = PLACES if last else TRIES
        look, box_m, wrong = _placed(sampler, reading, label, chance[rows], tries)
        stuck[rows] |= wrong > 0
        placed = wrong == 0
        rows = rows[placed]
        at = (rows, number[rows])
        rooms.object_class[at], rooms.is_object[at] = label[placed], True
        rooms.boxes_m[at], looks[at] = box_m[placed], look[placed]
        number[rows] += 1
    side_open = gaps_m(rooms, plan.rectangle_m).amax(dim=-1) > OPEN_M
    return rooms, stuck | (added & plan.drawn & side_open)


def read_rooms(
    sampler: RoomSampler,
    rooms: PosedRooms,
    number: Int[Tensor, " rooms"],
    rectangle_m: Float[Tensor, "rooms 4"],
    coming: Int[Tensor, "rooms wanted"],
) -> Reading:
    """Encode the first `number` objects of each room, and the classes still to come."""
    most = int(number.max())
    first = torch.arange(most, device=number.device) < number[:, None]
    before = rooms.changed(lambda part: part[:, :most]).only(first)
    still = sampler.contents.before(coming, coming != END)[:, -1]
    tokens = sampler.tokens(before, rectangle_m)
    return sampler.read(before, still, Frame.plain(rectangle_m), tokens)


def _placed(
    sampler: RoomSampler,
    reading: Reading,
    label: Int[Tensor, " rooms"],
    chance: Float[Tensor, "rooms numbers"],
    tries: int,
) -> tuple[Int[Tensor, " rooms"], Float[Tensor, "rooms 6"], Float[Tensor, " rooms"]]:
    """Sample a look and a box for an object of a class; also returns the violation of the box.

    The box is at the first of `tries` sampled places without a violation, or, if all places have
    one, at the place with the least violation.
    """
    look = draw_index(sampler.look_logits(reading, label), chance[:, 1])
    size_m = sampler.draw_size(look, chance[:, 2])
    bottom_m = sampler.bottom_m(look, size_m)
    places = sampler.place(reading, label, look, size_m, bottom_m)
    numbers = chance[:, 3:].unflatten(1, (PLACES, 4))[:, :tries]
    x = places.draw_x(numbers[..., :2])
    centre_m = torch.stack([x[:, 0], bottom_m + size_m[:, 1] / 2, x[:, 0]], dim=-1)
    boxes_m = torch.cat([centre_m, size_m], dim=-1)
    wrong = torch.full_like(bottom_m, torch.inf)
    for number in range(tries):
        rows = (wrong > 0).nonzero()[:, 0]
        if not len(rows):
            break
        tried_m = boxes_m[rows]
        tried_m[:, [0, 2]] = places.rows(rows).draw(x[rows, number], numbers[rows, number, 2:])
        some = reading.rows(rows)
        apart = ~sampler.may_meet[label[rows, None], some.before.object_class]
        tried_m = settled(tried_m, some, apart)
        found = violation(tried_m, some, apart)
        better = rows[found < wrong[rows]]
        boxes_m[better] = tried_m[found < wrong[rows]]
        wrong[rows] = torch.minimum(found, wrong[rows])
    return look, boxes_m, wrong


def with_looks(
    sampler: RoomSampler,
    uniform: Float[Tensor, "rooms slots numbers"],
    plan: Plan,
) -> PosedRooms:
    """The given objects, in as many slots as rooms have, each with a look: `LOOKS` looks are
    sampled by their likelihood and that of the size, then one of them by the likelihood of the
    place."""
    objects = plan.objects
    count, known = objects.is_object.shape
    still = torch.cat([objects.object_class * objects.is_object, plan.coming], dim=1)
    empty = (0, sampler.max_objects - known)
    looks = torch.zeros(count, sampler.max_objects, dtype=torch.int64)
    rooms = PosedRooms(
        F.pad(objects.object_class, empty), F.pad(objects.is_object, empty),
        F.pad(objects.boxes_m, (0, 0, *empty)), looks=looks,
    )  # fmt: skip
    for step in range(known):
        here = rooms.is_object[:, step]
        number = torch.full((count,), step)
        reading = read_rooms(sampler, rooms, number, plan.rectangle_m, still[:, step:])
        label = rooms.object_class[:, step].clamp(min=1)
        centre_m, size_m = rooms.boxes_m[:, step].split(3, dim=-1)
        size_m = size_m.where(here[:, None], 1.0)
        off = size_m.log().unsqueeze(1) - sampler.look_shown[: sampler.looks, -3:]
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

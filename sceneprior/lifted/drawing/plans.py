"""Plans of rooms, drawn before any object: shape, contents, and looks of given objects; and the
effort to furnish them."""

import warnings
from collections.abc import Sequence
from itertools import takewhile
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.core.colliders import HUNG
from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.mixtures import draw_index
from sceneprior.core.scene import Opening
from sceneprior.core.shell import rectangle
from sceneprior.lifted.prototypes import PosedRooms
from sceneprior.lifted.requests.checks import fronts_of
from sceneprior.lifted.requests.floors import Floor, RoomShape
from sceneprior.lifted.requests.openings import place_openings
from sceneprior.lifted.requests.wishes import Conditions
from sceneprior.lifted.sampler.contents import END
from sceneprior.lifted.sampler.frames import rectangle_sides, rectangles_of
from sceneprior.lifted.sampler.network import EncoderState, RoomSampler

RECTANGLES = 16
"""Rectangles sampled for a room without a requested floor. The first one that contains the given
objects and is large enough for the required ones is taken, or else the largest."""
BEYOND_M = 0.001
"""Distance that an object may extend beyond the rectangle."""
FULL_SHARE = 0.5
"""Largest share of a drawn rectangle that the mean footprints of required objects cover."""
CROWDED_SHARE = 1.2
"""Share of a requested floor above which the smallest footprints of required objects are assumed
not to fit. It is above 1, because some objects may overlap, such as a chair and a table."""
OPENING_TRIES = 400
"""Draws of the places of doors and windows on a requested floor, one of which must find them all.
They are the same for every seed and number of rooms, and the first one nearly always does."""
UNUSUAL = 0.001
"""Probability of drawing a smaller or larger floor below which a requested floor is unusual."""
LOOKS = 16
"""Looks sampled for a given object, one of which is chosen by the likelihood of its place."""
SIZE_DOUBT = 0.1
"""Standard deviation of the difference between the log extents of a given object and of its
look."""


class Effort(NamedTuple):
    """Numbers of particles and attempts at rooms."""

    particles: int
    """Particles of a room. With more, an attempt meets rarer wishes, in proportionally more
    time."""
    attempts: int
    """Maximum number of attempts at a room."""
    attempts_per_plan: int
    """Attempts before a room is planned anew."""
    whole: int
    """Attempts in which no object may be left out. Later ones place required objects first, and
    leave out others without a place; the last one leaves out any."""
    sound: int
    """Attempts in which no place may add a fault of function."""
    comfortable: int
    """Attempts in which none may add a fault of comfort either."""
    together: int
    """Particles for which attempts are made side by side, if fewer rooms are left; the first
    successful attempt counts. A step takes about as long for one room as for these."""


PLAIN = Effort(
    particles=1, attempts=48, attempts_per_plan=24, whole=47, sound=0, comfortable=0, together=32
)
"""For rooms whose conditions are inputs of the network: a rectangle, and given objects."""
REQUESTED = Effort(
    particles=6, attempts=12, attempts_per_plan=1, whole=4, sound=6, comfortable=2, together=1
)
"""For rooms with a floor, openings or wishes, which places are checked against."""


class RoomPlans(NamedTuple):
    """Shapes and contents of several rooms, one row per room."""

    rooms: PosedRooms
    """The given objects, with looks; other slots are empty."""
    rectangle_m: Float[Tensor, "rooms 4"]
    """Rectangle around the floor: centre x, z and extents x, z."""
    pieces_m: Float[Tensor, "rooms pieces 4"]
    """Rectangles in the floor, in one of which each object is placed."""
    upcoming: Int[Tensor, "rooms slots"]
    """Class to place in each step, followed by `END`."""
    required: Bool[Tensor, "rooms slots"]
    """True for objects that the wishes require."""
    shapes: list[RoomShape | None]
    """Floor, openings and ceiling; None for a room of which only the rectangle is known."""
    ceiling_m: float | None
    hangs: Bool[Tensor, " classes"]
    """True for classes that hang from a ceiling of known height."""
    given_front: Float[np.ndarray, "given 2"]
    """Fronts (x, z) of given objects with a yaw; NaN for others, whose looks say their fronts."""

    def take(self, rows: Int[Tensor, " some"]) -> "RoomPlans":
        """The plans of these rooms."""
        return RoomPlans(
            self.rooms.changed(lambda part: part[rows]), self.rectangle_m[rows],
            self.pieces_m[rows], self.upcoming[rows], self.required[rows],
            [self.shapes[row] for row in rows.tolist()], self.ceiling_m, self.hangs,
            self.given_front,
        )  # fmt: skip


def plan_rooms(
    sampler: RoomSampler,
    conditions: Conditions,
    draws: Sequence[np.random.Generator],
    required_first: bool = False,
) -> RoomPlans:
    """Draw what the conditions leave open: the rectangle, the places of openings, and contents.

    Contents start with the objects that the wishes require. Classes with the largest footprints are
    placed first, as in training; with `required_first`, required objects come before all others.

    Args:
        draws: Random numbers of each room.
    """
    slots, count = sampler.max_objects, len(draws)
    known = _given(conditions, slots)
    required = torch.tensor(conditions.required, dtype=torch.int64)
    each = 5 * RECTANGLES + slots
    numbers = torch.from_numpy(np.stack([own.random(each) for own in draws])).float()
    frames, uniform = numbers.split([5 * RECTANGLES, slots], dim=1)
    floor = conditions.floor
    if floor is None:
        choice, *normal = frames.unflatten(1, (RECTANGLES, 5)).unbind(dim=-1)
        noise = torch.special.ndtri(torch.stack(normal, dim=-1).clamp(1e-6, 1 - 1e-6))
        tried_m = sampler.rectangles(choice, noise)
        there = torch.cat([known.object_class[known.is_object], required])
        needed_m2 = float(sampler.footprints_m2[there].sum()) / FULL_SHARE
        enough_m2 = needed_m2 if len(required) else 0.0
        needed = rectangles_of(known)[0], enough_m2, bool(conditions.objects)
        rectangle_m = holding(tried_m, *needed)
        extents_m, pieces_m = rectangle_m[:, 2:], rectangle_m.unsqueeze(1)
    else:
        rectangle_m, extents_m, pieces_m = (
            torch.from_numpy(part).float().expand(count, *part.shape)
            for part in (floor.rectangle_m, floor.extents_m, floor.rectangles_m)
        )
    shapes = list[RoomShape | None]()
    for row, own in enumerate(draws):
        for skipped in range(RECTANGLES):
            if skipped and floor is None:  # as if those before had not been sampled
                rectangle_m[row] = holding(tried_m[row : row + 1, skipped:], *needed)[0]
            shape = _shape(conditions, rectangle_m[row].double().numpy(), own)
            if shape is None or not shape.lacks:
                break
        shapes.append(shape)
    counts = sampler.counts(known)[0]
    counts = (counts + F.one_hot(required, len(counts)).sum(dim=0)).expand(count, -1)
    free = slots - int(counts[0].sum())
    drawn = sampler.contents.draw(
        counts, torch.full((count,), free), extents_m, uniform,
        torch.tensor(conditions.most, dtype=counts.dtype),
    )  # fmt: skip
    upcoming = torch.cat([required.expand(count, -1), drawn], dim=1)[:, :slots]
    is_required = (torch.arange(slots) < len(required)).expand(count, -1)
    tickets = -sampler.footprints_m2.log()[upcoming] - 1e3 * (is_required & required_first)
    order = tickets.masked_fill(upcoming == END, torch.inf).argsort(dim=1, stable=True)
    upcoming, is_required = upcoming.gather(1, order), is_required.gather(1, order)
    rooms = known.changed(lambda part: part.repeat_interleave(count, dim=0))
    if conditions.objects:
        rooms = _with_looks(sampler, rooms, rectangle_m, upcoming, draws)
    hangs = torch.tensor([label in HUNG for label in conditions.classes])
    return RoomPlans(
        rooms, rectangle_m, pieces_m, upcoming, is_required, shapes, conditions.ceiling_m, hangs,
        fronts_of(conditions.objects),
    )  # fmt: skip


def _given(conditions: Conditions, slots: int) -> PosedRooms:
    """The given objects as one room."""
    known = len(conditions.objects)
    labels = torch.zeros(1, slots, dtype=torch.int64)
    boxes_m = torch.zeros(1, slots, 6)
    for row, item in enumerate(conditions.objects):
        labels[0, row] = conditions.classes.index(item.label)
        boxes_m[0, row] = torch.tensor([*item.center_m, *item.size_m])
    is_object = torch.arange(slots)[None] < known
    return PosedRooms(labels, is_object, boxes_m, looks=torch.zeros_like(labels))


def holding(
    tried_m: Float[Tensor, "rooms tries 4"],
    known_m: Float[Tensor, "4"],
    enough_m2: float,
    contains: bool,
) -> Float[Tensor, "rooms 4"]:
    """The first of the sampled rectangles with an area of `enough_m2` that, if `contains`, contains
    the rectangle `known_m`; if there is none, the largest, enlarged until it contains it."""
    low, high = rectangle_sides(tried_m)
    areas_m2 = tried_m[..., 2:].prod(dim=-1)
    fits = areas_m2 >= enough_m2
    known_low, known_high = rectangle_sides(known_m)
    if contains:
        fits = fits & ((low <= known_low + BEYOND_M) & (high >= known_high - BEYOND_M)).all(dim=-1)
    first = torch.where(fits.any(dim=1), fits.int().argmax(dim=1), areas_m2.argmax(dim=1))
    chosen = tried_m[torch.arange(len(tried_m)), first]
    if not contains:
        return chosen
    low, high = rectangle_sides(chosen)
    low, high = torch.minimum(low, known_low), torch.maximum(high, known_high)
    return torch.cat([(low + high) / 2, high - low], dim=-1)


def _shape(
    conditions: Conditions, rectangle_m: Float[np.ndarray, "4"], draws: np.random.Generator
) -> RoomShape | None:
    floor = conditions.floor
    if floor is None and not conditions.has_rules:
        return None
    if floor is None:
        middle, half = rectangle_m[:2], rectangle_m[2:] / 2
        floor = Floor(rectangle(middle - half, middle + half))
    wanted, lacks = conditions.openings, ""
    try:
        openings = place_openings(floor, wanted, draws)
    except InputError as error:
        given, lacks = [each for each in wanted if isinstance(each, Opening)], str(error)
        openings = place_openings(floor, given, draws)
    return RoomShape(floor, openings, conditions.ceiling_m, lacks)


def read_rooms(
    sampler: RoomSampler,
    rooms: PosedRooms,
    number: Int[Tensor, " rooms"],
    rectangle_m: Float[Tensor, "rooms 4"],
    coming: Int[Tensor, "rooms wanted"],
) -> EncoderState:
    """Encode the first `number` objects of each room, and the classes still to come."""
    most = int(number.max())
    first = torch.arange(most, device=number.device) < number[:, None]
    before = rooms.changed(lambda part: part[:, :most]).only(first)
    still = sampler.contents.before(coming, coming != END)[:, -1]
    untransformed = torch.zeros_like(number)
    tokens = sampler.tokens(before, rectangle_m)
    return sampler.read(before, still, rectangle_m, untransformed, tokens)


def _with_looks(
    sampler: RoomSampler,
    rooms: PosedRooms,
    rectangle_m: Float[Tensor, "rooms 4"],
    upcoming: Int[Tensor, "rooms slots"],
    draws: Sequence[np.random.Generator],
) -> PosedRooms:
    """The given objects with looks: `LOOKS` are sampled by their likelihood and that of the size,
    then one of them by the likelihood of the place."""
    count, known = len(rooms.is_object), int(rooms.is_object[0].sum())
    still = torch.cat([rooms.object_class[:, :known], upcoming], dim=1)
    uniform = torch.from_numpy(np.stack([own.random((known, 1 + LOOKS)) for own in draws])).float()
    assert rooms.looks is not None
    offers = sampler.offers()
    for step in range(known):
        number = torch.full((count,), step)
        state = read_rooms(sampler, rooms, number, rectangle_m, still[:, step:])
        label = rooms.object_class[:, step]
        centre_m, size_m = rooms.boxes_m[:, step].split(3, dim=-1)
        off = size_m.log().unsqueeze(1) - sampler.look_shown[: sampler.looks, -3:]
        logits = sampler.look_logits(state, label, offers)
        logits = logits - off.square().sum(dim=-1) / (2 * SIZE_DOUBT**2)
        some = draw_index(logits.unsqueeze(1).expand(-1, LOOKS, -1), uniform[:, step, 1:])
        bottom_m = centre_m[:, 1] - size_m[:, 1] / 2
        fits = [
            sampler.place(state, label, look, size_m, bottom_m).log_prob(centre_m[:, ::2])
            for look in some.unbind(dim=1)
        ]
        chosen = draw_index(torch.stack(fits, dim=1), uniform[:, step, 0])
        rooms.looks[:, step] = some.gather(1, chosen[:, None])[:, 0]
    return rooms


def check_floor(sampler: RoomSampler, conditions: Conditions, may_lack: bool) -> None:
    """Reject a requested floor on which the required objects do not fit, and warn if hardly any
    rectangle that the sampler draws is as small, or as large: the network extrapolates there.

    Args:
        may_lack: Required objects may be missing.

    Raises:
        InputError: the required objects at their smallest cover `CROWDED_SHARE` of the floor, or
            none of `OPENING_TRIES` draws finds places for the doors and windows.
    """
    floor = conditions.floor
    if floor is None:
        return
    tries = map(np.random.default_rng, range(OPENING_TRIES))
    shapes = (_shape(conditions, floor.rectangle_m, draws) for draws in tries)
    lacks = [*takewhile(bool, (shape.lacks for shape in shapes if shape))]
    if len(lacks) == OPENING_TRIES:
        raise InputError(lacks[0])
    area_m2, least_m2 = floor.polygon.area, 0.0
    for index in conditions.required:
        sizes = sampler.look_shown[sampler.look_class == index, -3:].exp()
        on_floor = sizes[:, [0, 2]].prod(dim=-1)
        least_m2 += float(on_floor.min()) if len(on_floor) else 0.0
    if least_m2 > CROWDED_SHARE * area_m2 and not may_lack:
        raise InputError(
            f"The required objects cover {least_m2:.1f} square metres at their smallest, but the "
            f"floor has {area_m2:.1f}; ask for fewer, or for a larger floor."
        )
    # The logarithm of an area is the sum of those of its extents, so it is normal, too.
    mean = sampler.rectangle_means[:, 2:].sum(dim=1)
    deviation = sampler.rectangle_factors[:, 2:].sum(dim=1).norm(dim=1)
    below = torch.special.ndtr((float(np.log(area_m2)) - mean) / deviation)
    smaller = float((sampler.rectangle_logits.softmax(dim=0) * below).sum())
    for share, word in ((smaller, "smaller"), (1 - smaller, "larger")):
        if share < UNUSUAL:
            warnings.warn(
                f"The floor of {area_m2:.1f} square metres is {word} than in nearly all training "
                "rooms of this prior, so rooms on it may lack the usual furniture.",
                InputWarning,
                stacklevel=2,
            )

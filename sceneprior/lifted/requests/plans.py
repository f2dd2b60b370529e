"""Plans of requested rooms: shape, classes to add and their order, drawn before any object."""

import warnings
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.mixtures import draw_index
from sceneprior.core.outline import rectangle
from sceneprior.lifted.requests.floors import Floor, RoomShape
from sceneprior.lifted.requests.openings import place_openings
from sceneprior.lifted.requests.request import Conditions
from sceneprior.lifted.requests.wishes import Wishes
from sceneprior.lifted.sampler.contents import END
from sceneprior.lifted.sampler.network import RoomSampler

RECTANGLES = 16
"""Number of rectangles sampled for a room without a requested floor. The first rectangle that is
large enough for the required objects is taken, or else the largest."""
FULL_SHARE = 0.5
"""Largest share of a drawn floor that the mean footprints of given and required objects cover."""
CROWDED_SHARE = 1.2
"""Share of a requested floor above which the smallest footprints of required objects are assumed
not to fit. It is above 1, because some objects may overlap, such as a chair and a table."""


UNUSUAL = 0.001
"""Probability of drawing a smaller or larger floor below which a requested floor is unusual."""


class RoomPlan(NamedTuple):
    """Shape and contents of one room."""

    shape: RoomShape
    upcoming: list[int]
    """Indices of the classes to add, in the order in which they are placed."""
    required: list[bool]
    """True for objects that the wishes require."""


def plan_room(
    sampler: RoomSampler,
    request: Conditions,
    classes: tuple[str, ...],
    draws: tuple[np.random.Generator, np.random.Generator],
    required_first: bool,
) -> RoomPlan:
    """Draw the parts of a room's shape that are not requested, and the room's contents.

    Classes with large footprints come first, as in training; with `required_first`, required
    objects come before all others.

    Args:
        draws: Generators of the shape, which is the same in all attempts, and of the contents.
    """
    given = [classes.index(item.label) for item in request.objects]
    required = required_rows(request.wishes, classes, given)
    floor = request.floor
    if floor is None:
        floor = Floor(_drawn_outline(sampler, request, [*given, *required], draws[0]))
    openings = place_openings(floor, request.openings, draws[0])
    shape = RoomShape(floor, openings, request.ceiling_m)
    uniform = draws[1].random(sampler.max_objects)
    upcoming = draw_contents(sampler, request.wishes, classes, given, floor.extents_m, uniform)
    is_required = np.arange(len(upcoming)) < len(required)
    footprints_m2 = sampler.footprints_m2.numpy()[upcoming] if upcoming else np.zeros(0)
    order = np.lexsort([-footprints_m2, ~is_required & required_first])
    return RoomPlan(shape, [upcoming[k] for k in order], [bool(is_required[k]) for k in order])


def _drawn_outline(
    sampler: RoomSampler, request: Conditions, needed: list[int], draws: np.random.Generator
) -> np.ndarray:
    needed_m2 = float(sampler.footprints_m2[needed].sum()) / FULL_SHARE
    numbers = torch.from_numpy(draws.random((RECTANGLES, 5))).float()
    noise = torch.special.ndtri(numbers[:, 1:].clamp(1e-6, 1 - 1e-6))
    rectangles_m = sampler.rectangles(numbers[:, 0], noise).double().numpy()
    areas_m2 = rectangles_m[:, 2:].prod(axis=1)
    enough = areas_m2 >= needed_m2
    half = rectangles_m[int(enough.argmax() if enough.any() else areas_m2.argmax()), 2:] / 2
    if request.objects:  # the floor must contain them
        boxes_m = np.array([[*item.center_m, *item.size_m] for item in request.objects])
        reach = (np.abs(boxes_m[:, [0, 2]]) + boxes_m[:, [3, 5]] / 2).max(axis=0)
        half = np.maximum(half, reach)
    return rectangle(-half, half)


def warn_of_area(sampler: RoomSampler, request: Conditions) -> None:
    """Warn if hardly any floor that the sampler draws is as small, or as large, as the requested
    one: the network extrapolates there, and the usual furniture may not fit."""
    if request.floor is None:
        return
    area_m2 = request.floor.polygon.area
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


def check_area(sampler: RoomSampler, request: Conditions, classes: tuple[str, ...]) -> None:
    """Reject requests whose objects need more floor than the request has.

    Raises:
        InputError: the required objects at their smallest cover `CROWDED_SHARE` of the floor.
    """
    if request.floor is None:
        return
    area_m2 = request.floor.polygon.area
    given = [classes.index(item.label) for item in request.objects]
    least_m2 = 0.0
    for index in required_rows(request.wishes, classes, given):
        sizes = sampler.look_shown[sampler.look_class == index, -3:].exp()
        on_floor = sizes[:, [0, 2]].prod(dim=-1)
        least_m2 += float(on_floor.min()) if len(on_floor) else 0.0
    if least_m2 > CROWDED_SHARE * area_m2:
        raise InputError(
            f"The required objects cover {least_m2:.1f} square metres at their smallest, but the "
            f"floor has {area_m2:.1f}; ask for fewer, or for a larger floor."
        )


def required_rows(wishes: Wishes, classes: tuple[str, ...], given: list[int]) -> list[int]:
    """The class index of each object that the wishes require beyond those in `given`, the class
    indices of the objects that are already there."""
    required = []
    for label in wishes.labels:
        index = classes.index(label)
        required += [index] * max(0, wishes.bounds(label)[0] - given.count(index))
    return required


def draw_contents(
    sampler: RoomSampler,
    wishes: Wishes,
    classes: tuple[str, ...],
    given: list[int],
    extents_m: Float[np.ndarray, "2"],
    uniform: Float[np.ndarray, " slots"],
) -> list[int]:
    """Classes to add to the given objects: first those that the wishes require, then others.

    The network was trained to continue any subset of a room's classes, so it draws the others given
    the required ones. A class that has reached its largest allowed number is excluded.
    """
    added = required_rows(wishes, classes, given)
    counts = torch.zeros(1, len(sampler.contents.known))
    for index in (*given, *added):
        counts[0, index] += 1
    most = torch.full_like(counts[0], torch.inf)
    for label in wishes.labels:
        largest = wishes.bounds(label)[1]
        if largest is not None:
            most[classes.index(label)] = largest
    extents = torch.from_numpy(extents_m).to(counts)[None]
    for chance in torch.from_numpy(uniform).float():
        if int(counts.sum()) >= sampler.max_objects:
            break
        full = counts[0] >= most
        full[END] = False
        logits = sampler.contents(counts, extents).masked_fill(full, -torch.inf)
        index = int(draw_index(logits, chance[None]))
        if index == END:
            break
        added.append(index)
        counts[0, index] += 1
    return added

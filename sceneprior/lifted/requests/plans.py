"""Plans of requested rooms: shape, classes to add and their order, drawn before any object."""

import warnings
from typing import NamedTuple

import numpy as np
import torch

from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.outline import rectangle
from sceneprior.lifted.requests.contents import draw_contents, required_rows
from sceneprior.lifted.requests.openings import place_openings
from sceneprior.lifted.requests.request import Request
from sceneprior.lifted.requests.shape import RoomShape
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
    request: Request,
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
    outline_m = request.outline_m
    if outline_m is None:
        outline_m = _drawn_outline(sampler, request, [*given, *required], draws[0])
    openings = place_openings(outline_m, request.openings, draws[0])
    shape = RoomShape(outline_m, openings, request.ceiling_m)
    uniform = draws[1].random(sampler.max_objects)
    upcoming = draw_contents(sampler, request.wishes, classes, given, shape.extents_m, uniform)
    is_required = np.arange(len(upcoming)) < len(required)
    footprints_m2 = sampler.footprints_m2.numpy()[upcoming] if upcoming else np.zeros(0)
    order = np.lexsort([-footprints_m2, ~is_required & required_first])
    return RoomPlan(shape, [upcoming[k] for k in order], [bool(is_required[k]) for k in order])


def _drawn_outline(
    sampler: RoomSampler, request: Request, needed: list[int], draws: np.random.Generator
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


def warn_of_area(sampler: RoomSampler, request: Request) -> None:
    """Warn if hardly any floor that the sampler draws is as small, or as large, as the requested
    one: the network extrapolates there, and the usual furniture may not fit."""
    if request.outline_m is None:
        return
    area_m2 = RoomShape(request.outline_m).polygon.area
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


def check_area(sampler: RoomSampler, request: Request, classes: tuple[str, ...]) -> None:
    """Reject requests whose objects need more floor than the request has.

    Raises:
        InputError: the required objects at their smallest cover `CROWDED_SHARE` of the floor.
    """
    if request.outline_m is None:
        return
    area_m2 = RoomShape(request.outline_m).polygon.area
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

"""Sampling of requested rooms: sequential Monte Carlo, repeated until every wish holds."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from sceneprior.core.colliders import HUNG
from sceneprior.core.errors import InputError
from sceneprior.lifted.requests.particles import PARTICLES, Particles, start_particles
from sceneprior.lifted.requests.plans import RoomPlan, check_area, plan_room, warn_of_area
from sceneprior.lifted.requests.relations import furniture_in
from sceneprior.lifted.requests.request import Conditions
from sceneprior.lifted.requests.rules import PlacementRules
from sceneprior.lifted.requests.steps import Rejections, place_next
from sceneprior.lifted.requests.wishes import RelationWish, check_wishes
from sceneprior.lifted.rooms import PosedRooms
from sceneprior.lifted.sampler.draw import LOOKS, with_looks
from sceneprior.lifted.sampler.network import RoomSampler
from sceneprior.lifted.sampler.plan import Plan

ATTEMPTS = 8
"""Maximum number of attempts at a room."""
REQUIRED_FIRST = 4
"""Index of the attempt (from 0) from which required objects are placed first, and other objects
without a place are left out."""
BATCH = 32
"""Rooms drawn at a time."""


@dataclass(frozen=True)
class Answer:
    """A sampled room."""

    plan: RoomPlan
    room: PosedRooms
    """The room, as a batch of one."""
    missing: tuple[int, ...] = ()
    """Classes of required objects that found no place."""


@torch.no_grad()
def draw_requested(
    sampler: RoomSampler, request: Conditions, classes: tuple[str, ...], count: int, seed: int
) -> list[Answer]:
    """Sample rooms that meet a request.

    The parts of a room's floor and contents that the request leaves open are sampled first. Then
    the objects are placed in `PARTICLES` copies of the room at once: in each step, every copy
    samples a place for the next object among those that the request allows, and copies without such
    a place are replaced by others. An attempt fails if no copy is left; there are at most
    `ATTEMPTS`. The last attempt also leaves out required objects without a place.

    A seed always draws the same rooms, and the first ones do not depend on `count`.

    Raises:
        InputError: no room can meet the request, or none was found; the message gives the reason.
    """
    check_wishes(
        request.wishes, [classes[row] for row in sampler.drawn_classes], request.given,
        sampler.max_objects,
    )  # fmt: skip
    check_area(sampler, request, classes)
    warn_of_area(sampler, request)
    given = _given(sampler, request, classes, seed)
    answers: list[Answer | None] = [None] * count
    rejections: Rejections = Counter()
    for number in range(ATTEMPTS):
        waiting = [row for row, answer in enumerate(answers) if answer is None]
        for start in range(0, len(waiting), BATCH):
            rows = waiting[start : start + BATCH]
            draws = [np.random.default_rng([seed, row, number + 1]) for row in rows]
            plans = [
                plan_room(
                    sampler, request, classes, (np.random.default_rng([seed, row, 0]), own),
                    number >= REQUIRED_FIRST,
                )
                for row, own in zip(rows, draws, strict=True)
            ]  # fmt: skip
            found = _furnish(
                sampler, plans, given, draws, request.wishes.relations, classes, number, rejections
            )
            for row, answer in zip(rows, found, strict=True):
                answers[row] = answer
    drawn = [answer for answer in answers if answer is not None]
    assert len(drawn) == count, "the last round leaves out what has no place"
    if all(answer.missing for answer in drawn):
        raise InputError(_in_the_way(rejections, drawn[0].missing, classes))
    return drawn


def _given(
    sampler: RoomSampler, request: Conditions, classes: tuple[str, ...], seed: int
) -> PosedRooms:
    """The given objects as one room with looks."""
    objects = request.objects
    boxes_m = [[*item.center_m, *item.size_m] for item in objects]
    labels = torch.tensor([[classes.index(item.label) for item in objects]], dtype=torch.int64)
    known = PosedRooms(
        labels, torch.ones_like(labels, dtype=torch.bool),
        torch.tensor(boxes_m).float().reshape(1, -1, 6),
    )  # fmt: skip
    rectangle_m = np.array([0.0, 0.0, 4.0, 4.0])
    if request.floor is not None:
        rectangle_m = request.floor.rectangle_m
    extents_m = torch.from_numpy(rectangle_m[None]).float()
    uniform = np.random.default_rng([seed, 0]).random((1, len(objects), 1 + LOOKS))
    none = torch.zeros(1, 0, dtype=torch.int64)
    return with_looks(
        sampler, torch.from_numpy(uniform).float(), Plan(known, extents_m, none, False)
    )


def _furnish(
    sampler: RoomSampler,
    plans: Sequence[RoomPlan],
    given: PosedRooms,
    draws: Sequence[np.random.Generator],
    relations: Sequence[RelationWish],
    classes: tuple[str, ...],
    number: int,
    rejections: Rejections,
) -> list[Answer | None]:
    """Make one attempt at each room; None for rooms in which an object found no place."""
    particles = start_particles(sampler, plans, given)
    objects = furniture_in(sampler, given, 0)
    rules = [PlacementRules(plan.shape, relations, classes, objects) for plan in plans]
    hanging = [classes.index(label) for label in HUNG if label in classes]
    failed = [False] * len(plans)
    missing: list[list[int]] = [[] for _ in plans]
    for step in range(max((len(plan.upcoming) for plan in plans), default=0)):
        place_next(sampler, particles, rules, step, draws, hanging, rejections)
        for room, plan in enumerate(plans):
            rows = particles.rows_of(room)
            if step >= len(plan.upcoming) or failed[room] or particles.alive[rows].all():
                continue
            if particles.alive[rows].any():
                particles.replace_dead(room, draws[room])
            elif number < REQUIRED_FIRST or (plan.required[step] and number + 1 < ATTEMPTS):
                failed[room] = True
            else:  # left out
                particles.alive[rows] = True
                missing[room] += [plan.upcoming[step]] if plan.required[step] else []
    return [
        None if failed[room] else _answer(particles, room, missing[room])
        for room in range(len(plans))
    ]


def _answer(particles: Particles, room: int, missing: list[int]) -> Answer:
    """The first particle of a room; all remaining particles meet the request."""
    row = room * PARTICLES
    drawn = particles.rooms.changed(lambda part: part[row : row + 1].clone())
    return Answer(particles.plans[room], drawn, tuple(missing))


def _in_the_way(rejections: Rejections, missing: Sequence[int], classes: tuple[str, ...]) -> str:
    """The error message for a request that no attempt met."""
    label = missing[0]
    own = Counter({what: times for (index, what), times in rejections.items() if index == label})
    what = own.most_common(1)[0][0] if own else "free floor"
    return (
        f"No room holds the request: in {ATTEMPTS} attempts with {PARTICLES} partial rooms each, a "
        f"{classes[label].replace('_', ' ')} found no place; most places lacked {what}. Ask for "
        "less, or for a larger floor."
    )

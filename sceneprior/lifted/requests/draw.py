"""Draw requested rooms: attempts of sequential Monte Carlo until every wish holds."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from sceneprior.core.errors import InputError
from sceneprior.core.views import RoomBoxes
from sceneprior.lifted.requests.holding import furniture_in
from sceneprior.lifted.requests.judge import Judge
from sceneprior.lifted.requests.particles import PARTICLES, Particles, begin
from sceneprior.lifted.requests.plans import RoomPlan, check_area, plan_room
from sceneprior.lifted.requests.request import Request
from sceneprior.lifted.requests.steps import HANGING, Hurdles, place_next
from sceneprior.lifted.requests.wishes import RelationWish, check_wishes
from sceneprior.lifted.sampler.draw import LOOKS, with_looks
from sceneprior.lifted.sampler.network import RoomSampler
from sceneprior.lifted.sampler.plan import Plan

ROUNDS = 8
"""Attempts at a room."""
LATE = 4
"""Attempt from which wanted objects come first, and others without a place are left out."""
BATCH = 32
"""Rooms drawn at a time."""


@dataclass(frozen=True)
class Answer:
    """A drawn room."""

    plan: RoomPlan
    room: RoomBoxes
    """The room, alone in its batch."""
    lacking: tuple[int, ...] = ()
    """Classes of wanted objects without a place."""


@torch.no_grad()
def draw_requested(
    sampler: RoomSampler, request: Request, classes: tuple[str, ...], count: int, seed: int
) -> list[Answer]:
    """New rooms as requested.

    A room's floor and contents are drawn first, as far as the request leaves them open. Its
    objects are then placed in `PARTICLES` copies of the room at once: in each step every copy takes
    a place that the request allows, drawn by the sampler, and copies without such a place are
    replaced by others. An attempt fails if no copy is left; there are at most `ROUNDS`. In the last
    one, wanted objects without a place are left out, too.

    The same seed draws the same rooms, and the first ones do not depend on `count`.

    Raises:
        InputError: no room can hold the request, or none was found; it says what is in the way.
    """
    check_wishes(
        request.wishes, [classes[row] for row in sampler.drawn_classes], request.given,
        sampler.max_objects,
    )  # fmt: skip
    check_area(sampler, request, classes)
    given = _given(sampler, request, classes, seed)
    answers: list[Answer | None] = [None] * count
    hurdles: Hurdles = Counter()
    for number in range(ROUNDS):
        waiting = [row for row, answer in enumerate(answers) if answer is None]
        for start in range(0, len(waiting), BATCH):
            rows = waiting[start : start + BATCH]
            draws = [np.random.default_rng([seed, row, number + 1]) for row in rows]
            plans = [
                plan_room(
                    sampler, request, classes, (np.random.default_rng([seed, row, 0]), own),
                    number >= LATE,
                )
                for row, own in zip(rows, draws, strict=True)
            ]  # fmt: skip
            found = _furnish(
                sampler, plans, given, draws, request.wishes.relations, classes, number, hurdles
            )
            for row, answer in zip(rows, found, strict=True):
                answers[row] = answer
    drawn = [answer for answer in answers if answer is not None]
    assert len(drawn) == count, "the last round leaves out what has no place"
    if all(answer.lacking for answer in drawn):
        raise InputError(_in_the_way(hurdles, drawn[0].lacking, classes))
    return drawn


def _given(
    sampler: RoomSampler, request: Request, classes: tuple[str, ...], seed: int
) -> RoomBoxes:
    """The given objects as one room with looks."""
    objects = request.objects
    boxes_m = [[*item.center_m, *item.size_m] for item in objects]
    labels = torch.tensor([[classes.index(item.label) for item in objects]], dtype=torch.int64)
    known = RoomBoxes(
        labels, torch.ones_like(labels, dtype=torch.bool),
        torch.tensor(boxes_m).float().reshape(1, -1, 6),
    )  # fmt: skip
    if request.outline_m is None:
        extents_m = torch.tensor([[0.0, 0.0, 4.0, 4.0]])
    else:
        low, high = request.outline_m.min(axis=0), request.outline_m.max(axis=0)
        extents_m = torch.from_numpy(np.concatenate([(low + high) / 2, high - low])[None]).float()
    uniform = np.random.default_rng([seed, 0]).random((1, len(objects), 1 + LOOKS))
    none = torch.zeros(1, 0, dtype=torch.int64)
    return with_looks(
        sampler, torch.from_numpy(uniform).float(), Plan(known, extents_m, none, False)
    )


def _furnish(
    sampler: RoomSampler,
    plans: Sequence[RoomPlan],
    given: RoomBoxes,
    draws: Sequence[np.random.Generator],
    relations: Sequence[RelationWish],
    classes: tuple[str, ...],
    number: int,
    hurdles: Hurdles,
) -> list[Answer | None]:
    """One attempt at each room; None where an object found no place."""
    particles = begin(sampler, plans, given)
    objects = furniture_in(sampler, given, 0)
    judges = [Judge(plan.shape, relations, classes, objects) for plan in plans]
    hanging = [classes.index(label) for label in HANGING if label in classes]
    failed = [False] * len(plans)
    lacking: list[list[int]] = [[] for _ in plans]
    for step in range(max((len(plan.coming) for plan in plans), default=0)):
        place_next(sampler, particles, judges, step, draws, hanging, hurdles)
        for room, plan in enumerate(plans):
            rows = particles.rows_of(room)
            if step >= len(plan.coming) or failed[room] or particles.alive[rows].all():
                continue
            if particles.alive[rows].any():
                particles.replace_dead(room, draws[room])
            elif number < LATE or (plan.wanted[step] and number + 1 < ROUNDS):
                failed[room] = True
            else:  # left out
                particles.alive[rows] = True
                lacking[room] += [plan.coming[step]] if plan.wanted[step] else []
    return [
        None if failed[room] else _answer(particles, room, lacking[room])
        for room in range(len(plans))
    ]


def _answer(particles: Particles, room: int, lacking: list[int]) -> Answer:
    """The first of a room's particles: all of them met what was asked."""
    row = room * PARTICLES
    drawn = particles.rooms.changed(lambda part: part[row : row + 1].clone())
    return Answer(particles.plans[room], drawn, tuple(lacking))


def _in_the_way(hurdles: Hurdles, lacking: Sequence[int], classes: tuple[str, ...]) -> str:
    """The sentence for a request that no attempt met."""
    label = lacking[0]
    own = Counter({what: times for (index, what), times in hurdles.items() if index == label})
    what = own.most_common(1)[0][0] if own else "free floor"
    return (
        f"No room holds the request: in {ROUNDS} attempts with {PARTICLES} partial rooms each, a "
        f"{classes[label].replace('_', ' ')} found no place; most places lacked {what}. Ask for "
        "less, or for a larger floor."
    )

"""Rooms drawn by a sampler, as scenes: sequential Monte Carlo over partly furnished rooms, repeated
until they are whole. A plain room has no wishes and one particle."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.core.classes import UnknownClassError, label_set
from sceneprior.core.scene import Mesh, Scene, SceneObject, Solid, quarter_turned
from sceneprior.core.shell import rectangle
from sceneprior.lifted.drawing.plans import (
    PLAIN,
    REQUESTED,
    Effort,
    RoomPlans,
    check_floor,
    plan_rooms,
)
from sceneprior.lifted.drawing.steps import NUMBERS, Particles, Rejections, place_next
from sceneprior.lifted.lifting import HANGS_M
from sceneprior.lifted.prototype_decoder import PrototypeDecoder
from sceneprior.lifted.prototypes import POSES, PosedRooms
from sceneprior.lifted.requests.checks import answers, remarks
from sceneprior.lifted.requests.floors import RoomShape
from sceneprior.lifted.requests.relations import furniture_in
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.lifted.requests.rules import PlacementRules
from sceneprior.lifted.requests.wishes import Conditions
from sceneprior.lifted.sampler.contents import END
from sceneprior.lifted.sampler.frames import FRAME_M, gaps_m, side_of
from sceneprior.lifted.sampler.network import RoomSampler
from sceneprior.lifted.trained import TrainedLifted

OPEN_M = 3 * FRAME_M
"""Distance in metres beyond which a side of a drawn rectangle counts as empty: 1 of 370 sides in
the training rooms exceeds it."""
BATCH = 512
"""Particles furnished at a time."""


class SampledRooms(NamedTuple):
    """Sampled rooms; every part has one entry per room."""

    rooms: PosedRooms
    """Given objects come first, with their own boxes."""
    shapes: tuple[RoomShape | None, ...]
    """None for a room of which only the rectangle is known (`PosedRooms.rectangle_m`)."""
    missing: tuple[tuple[int, ...], ...]
    """Classes of required objects that found no place."""
    lacks: tuple[str, ...]
    """Why what the conditions require is missing, as a sentence; empty if nothing is."""


@torch.no_grad()
def draw_rooms(
    sampler: RoomSampler,
    conditions: Conditions,
    count: int,
    seed: int,
    may_lack: bool = False,
    first: int = 0,
) -> SampledRooms:
    """Sample new rooms that meet conditions.

    What the conditions leave open of a room's rectangle and contents is sampled first
    (`plan_rooms`), then its objects one by one, in every particle at the first of a few sampled
    places where it neither intersects an object that it should not (`RoomSampler.may_meet`) nor
    extends beyond the rectangle nor breaks a rule. Particles without such a place are replaced by
    others; if none is left, the room is furnished again. So it is if a side of its sampled
    rectangle stays empty (`OPEN_M`), which is rare in training rooms.

    A seed always draws the same rooms, and the first ones do not depend on `count`.

    Args:
        may_lack: The floor may be too small for the required objects.
        first: Number of the first room, of those that the seed draws.

    Raises:
        InputError: no room can meet the conditions; the message says why.
    """
    check_floor(sampler, conditions, may_lack)
    effort, rejections = REQUESTED if conditions.has_rules else PLAIN, Rejections()
    slots, size = sampler.max_objects, max(1, BATCH // effort.particles)
    none = torch.zeros(count, slots, dtype=torch.int64)
    rooms = PosedRooms(none, none > 0, torch.zeros(count, slots, 6), looks=none.clone())
    rectangle_m, finished = torch.zeros(count, 4), set[int]()
    shapes: list[RoomShape | None] = [None] * count
    missing: list[tuple[int, ...]] = [()] * count
    waiting, number, last = list(range(count)), 0, effort.attempts - 1
    while waiting:
        if number % effort.attempts_per_plan == 0:
            planned = {row: at for at, row in enumerate(waiting)}
            draws = [np.random.default_rng([seed, first + row, 0, number]) for row in waiting]
            plans = plan_rooms(sampler, conditions, draws, number >= effort.whole)
        # The very last attempt is by itself, because it leaves out objects.
        until = effort.attempts_per_plan * (number // effort.attempts_per_plan + 1)
        until = min(number + max(1, effort.together // len(waiting)), until, last)
        attempts = range(number, max(until, number + 1))
        for start in range(0, len(waiting), size):
            some = waiting[start : start + size]
            tried = [(row, attempt) for attempt in attempts for row in some]
            own = plans.take(torch.tensor([planned[row] for row, _ in tried]))
            draws = [
                np.random.default_rng([seed, first + row, 1, attempt]) for row, attempt in tried
            ]
            particles, best, lacking = _furnish(
                sampler, conditions, own, draws, number, effort, rejections
            )
            # The first successful attempt counts, so later ones are overwritten.
            earliest = {tried[at][0]: at for at in reversed(range(len(tried))) if best[at] >= 0}
            for row, at in earliest.items():
                shapes[row], missing[row] = own.shapes[at], tuple(lacking[at])
            to, chosen = torch.tensor([*earliest]).long(), torch.tensor([*earliest.values()]).long()
            for whole, part in zip(_parts(rooms), _parts(particles.rooms), strict=True):
                whole[to] = part[best[chosen]]
            rectangle_m[to] = own.rectangle_m[chosen]
            finished |= earliest.keys()
        waiting = [row for row in waiting if row not in finished]
        number = attempts.stop
    lacks = tuple(
        _in_the_way(rejections, own, conditions.classes) if own else shape.lacks if shape else ""
        for own, shape in zip(missing, shapes, strict=True)
    )
    rooms = replace(rooms, rectangle_m=rectangle_m)
    return SampledRooms(rooms, tuple(shapes), tuple(missing), lacks)


def _parts(rooms: PosedRooms) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    assert rooms.looks is not None
    return rooms.object_class, rooms.is_object, rooms.boxes_m, rooms.looks


def _furnish(
    sampler: RoomSampler,
    conditions: Conditions,
    plans: RoomPlans,
    draws: Sequence[np.random.Generator],
    number: int,
    effort: Effort,
    rejections: Rejections,
) -> tuple[Particles, Int[Tensor, " rooms"], list[list[int]]]:
    """Make attempt `number` at each room.

    Returns:
        The particles; the best one of each room, or -1 if the room is to be furnished again; and
        the classes of required objects that were left out.
    """
    rules, particles = None, Particles(sampler, plans, effort.particles)
    if conditions.has_rules:
        given = particles.furniture()[:: effort.particles]
        relations = conditions.wishes.relations
        rules = particles.rules = [
            PlacementRules(shape, relations, conditions.classes, own, number < effort.comfortable)
            for shape, own in zip(plans.shapes, given, strict=True)
            if shape is not None
        ]
    shape = (sampler.max_objects, effort.particles, NUMBERS)
    numbers = torch.from_numpy(np.stack([own.random(shape) for own in draws])).float()
    failed: set[int] = set()
    missing: list[list[int]] = [[] for _ in draws]
    for step in range(max((plans.upcoming != END).sum(dim=1).tolist(), default=0)):
        place_next(particles, step, numbers[:, step].flatten(0, 1), draws, rejections)
        dead = (~particles.alive).unflatten(0, (-1, effort.particles)).any(dim=1)
        for room in set(dead.nonzero()[:, 0].tolist()) - failed:
            required = bool(plans.required[room, step])
            rows = slice(room * effort.particles, (room + 1) * effort.particles)
            if particles.alive[rows].any():
                particles.replace_dead(room, draws[room])
            elif number < effort.whole or (required and number < effort.attempts - 1):
                failed.add(room)
            else:  # left out
                particles.alive[rows] = True
                missing[room] += [int(plans.upcoming[room, step])] * required
    good = particles.alive
    if number < effort.whole:
        whole = torch.tensor([shape is None or not shape.lacks for shape in plans.shapes])
        good = good & whole[particles.room]
    if conditions.floor is None and number < effort.whole:
        added = (plans.upcoming != END).any(dim=1)[particles.room]
        gaps = gaps_m(particles.rooms, plans.rectangle_m[particles.room])
        good = good & ~(added & (gaps.amax(dim=-1) > OPEN_M))
    merit = good.int()
    if rules is not None:  # the room with the fewest faults
        allowed = [own.faults(there) for own, there in zip(rules, given, strict=True)]
        for row, own in enumerate(particles.furniture()):
            new = rules[room := int(particles.room[row])].faults(own) - allowed[room]
            merit[row] *= 100 - len(new)
            good[row] &= number >= effort.sound or not new
    good, merit = (part.unflatten(0, (-1, effort.particles)) for part in (good, merit))
    best = torch.arange(len(draws)) * effort.particles + merit.argmax(dim=1)
    return particles, best.where(good.any(dim=1), -1), missing


def _in_the_way(rejections: Rejections, missing: Sequence[int], classes: Sequence[str]) -> str:
    """The reason why a room lacks a required object."""
    label = missing[0]
    own = Counter({what: times for (index, what), times in rejections.items() if index == label})
    what = own.most_common(1)[0][0] if own else "free floor"
    return (
        f"in {REQUESTED.attempts} attempts with {REQUESTED.particles} partial rooms each, a "
        f"{classes[label].replace('_', ' ')} found no place; most places lacked {what}."
    )


def sample_scenes(
    trained: TrainedLifted,
    names: Sequence[str],
    seed: int,
    request: RoomRequest | None,
    classes: Sequence[str] | None,
    floor_stays: bool,
    with_models: Callable[[list[Scene]], list[Scene]] | None = None,
    first: int = 0,
) -> list[Scene]:
    """Sample a room with meshes for each name; see `draw_rooms` (also for `first`).

    `extra` of a room lists the rows of the given objects (`given`), the request without them
    (`request`), whether each wish holds (`wishes`), and why required things are missing (`lacks`).

    Args:
        classes: Classes of the objects to add to the given ones, and no others; instead of wishes.
            `extra["no_place"]` lists those for which no place was found.
        floor_stays: Never move the floor; otherwise, a floor without given objects is centred.
        with_models: Replaces meshes by models; wishes are checked after it.

    Raises:
        InputError: the prior does not understand the request, or no room can meet it.
    """
    sampler, label_names = trained.sampler, label_set(trained.config.label_set)
    assert sampler is not None, "callers ask trained.sampler first"
    known = [label_names[row] for row in sampler.drawn_classes]
    if classes is not None:
        for label in classes:
            if label not in known:
                raise UnknownClassError(label, known)
        request = request or RoomRequest()
        whole = Counter(classes) + Counter(item.label for item in request.objects)
        want = {label: whole[label] for label in known}
        request = RoomRequest.of(**{**request.parts(), "want": want})
    conditions, told = Conditions(tuple(label_names)), dict[str, Any]()
    if request is not None:
        labels, most = trained.config.label_set, sampler.max_objects
        meets = sampler.may_meet.nonzero().tolist()
        may_meet = {frozenset(label_names[index] for index in pair) for pair in meets}
        conditions = request.conditions(known, labels, most, floor_stays, may_meet)
        told = {key: part for key, part in request.parts().items() if key != "objects"}
    drawn = draw_rooms(sampler, conditions, len(names), seed, classes is not None, first)
    scenes = []
    for row, name in enumerate(names):
        extra: dict[str, Any] = {}
        if classes is not None:
            extra["no_place"] = sorted(label_names[index] for index in drawn.missing[row])
        elif told:
            extra = {"request": told, "wishes": []}
            extra |= {"lacks": drawn.lacks[row]} if drawn.lacks[row] else {}
        if conditions.objects:
            extra["given"] = list(range(len(conditions.objects)))
        scene = _scene_of(trained, name, conditions, drawn, row, with_models is not None)
        scenes.append(_answered(replace(scene, extra=extra), sampler, conditions, drawn, row))
    if with_models is None:
        return scenes
    rooms = enumerate(with_models(scenes))
    return [_answered(room, sampler, conditions, drawn, row) for row, room in rooms]


def _answered(
    scene: Scene, sampler: RoomSampler, conditions: Conditions, drawn: SampledRooms, row: int
) -> Scene:
    """A requested room with the answers to its wishes, if it has any, and with remarks."""
    if "wishes" not in scene.extra:
        return scene
    found = answers(scene, conditions, furniture_in(sampler, drawn.rooms, row).front)
    return replace(scene, extra={**scene.extra, "wishes": found, "remarks": remarks(scene)})


def _scene_of(
    trained: TrainedLifted,
    name: str,
    conditions: Conditions,
    drawn: SampledRooms,
    row: int,
    turns_given: bool,
) -> Scene:
    """Convert a sampled room to a scene with meshes; its floor is the room's rectangle, unless the
    request has another.

    Yaws of objects are those of the fronts of their looks (`orient`). Given objects stay as they
    are; those without a mesh get that of their look and, if `turns_given`, its yaw.
    """
    sampler, shapes, rooms = trained.sampler, trained.prior.shape, drawn.rooms
    assert isinstance(shapes, PrototypeDecoder), "whose looks the sampler draws"
    assert sampler is not None and rooms.looks is not None and rooms.rectangle_m is not None
    fronts = side_of(rooms.looks[row], sampler.fronts)
    confidence = sampler.front_confidence[rooms.looks[row] // POSES]
    known = sampler.is_known(rooms)[row]  # others get no mesh
    objects = []
    for item in rooms.is_object[row].nonzero()[:, 0].tolist():
        box = rooms.boxes_m[row, item].double().numpy()
        look, index = int(rooms.looks[row, item]), int(rooms.object_class[row, item])
        if item >= len(conditions.objects) and box[1] - box[4] / 2 < HANGS_M:
            box[1] = box[4] / 2  # lifted boxes end a little above the floor
        mesh, solids = _shape_in(shapes, look, box) if known[item] else (None, ())
        center, size = tuple(box[:3]), tuple(box[3:])
        # A front at high z, high x, low z or low x is turned by 0, 1, 2 or 3 quarters.
        turned = quarter_turned(size, int(fronts[item]) + 2)._replace(
            confidence=float(confidence[item])
        )
        own = SceneObject(conditions.classes[index], center, size, mesh, turned, solids)
        if item < len(conditions.objects):
            own = conditions.objects[item]
            if own.mesh is None:
                yaw = own.turned or (turned if turns_given else None)
                own = replace(own, mesh=mesh, solids=solids, turned=yaw)
        objects.append(own)
    if (shape := drawn.shapes[row]) is None:
        middle, extents = rooms.rectangle_m[row].double().numpy().reshape(2, 2)
        floor_m = rectangle(middle - extents / 2, middle + extents / 2).round(3)
        return Scene(name, trained.config.label_set, tuple(objects), floor_m)
    return Scene(
        name, trained.config.label_set, tuple(objects), shape.floor.outline_m,
        openings=shape.openings, ceiling_m=shape.ceiling_m,
    )  # fmt: skip


def _shape_in(
    shapes: PrototypeDecoder, look: int, box_m: Float[np.ndarray, "6"]
) -> tuple[Mesh, tuple[Solid, ...]]:
    """Mesh and solids of a look in a box. If the box stands on the floor, so does the shape: masks
    show too little of the lowest parts of some prototypes."""
    solids = shapes.solids(look, box_m)
    bottom, top = box_m[1] - box_m[4] / 2, box_m[1] + box_m[4] / 2
    lowest = min(solid.low_m[1] for solid in solids)
    if bottom <= 0 < lowest < top / 2:
        # Parts keep their relative heights, so the empty share of the height is lowest / top.
        height = top / (1 - lowest / top)
        box_m = np.array([box_m[0], top - height / 2, box_m[2], box_m[3], height, box_m[5]])
        solids = shapes.solids(look, box_m)
    return shapes.mesh(look, box_m), solids

"""Insert given objects into a room, in place of the objects that they match or collide with."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from sceneprior.core.boxes import match_scenes, shared_of_smaller
from sceneprior.core.scene import Scene, SceneObject

BADLY = 0.25
"""Overlap, as a share of the smaller of two volumes, above which an object of the room is
removed in favour of a given one: a chair pushed under a table may stay, a wardrobe in a bed may
not."""


def insert(
    room: Scene,
    given: Scene,
    may_meet: Bool[np.ndarray, "classes classes"] | None = None,
    **extra: Any,
) -> Scene:
    """A scene with the given objects first, unchanged, then the room's remaining objects.

    Two kinds of the room's own objects are removed:

    - objects that match a given one: of the same class, paired one to one by their boxes (see
      `match_scenes`). A given object without a mesh takes the mesh of its match;
    - other objects that overlap a given one badly (`BADLY`), unless their classes may overlap.

    The result has the floor of `given`, if it has one. `may_meet` is true for pairs of classes that
    may overlap, such as a chair and its table; None allows no pair. The result's `extra` holds
    `extra`, `given` (the rows of the given objects), `replaced` and `removed` (the number of
    objects removed for either reason), and `replaced_off_m` (mean distance in metres, over centre
    and sides, between the matches and the given objects; null if there are none).
    """
    given = replace(given, label_set=room.label_set)
    partners = _partners(room, given)
    badly = shared_of_smaller(room, given) > BADLY
    if may_meet is not None:
        badly &= ~may_meet[np.ix_(room.class_indices, given.class_indices)]
    clashing = set(np.flatnonzero(badly.any(axis=1)).tolist())
    clashing -= set(partners.values())
    placed = [
        _with_mesh(item, room.objects[partners[row]]) if row in partners else item
        for row, item in enumerate(given.objects)
    ]
    gone = clashing | set(partners.values())
    added = [item for row, item in enumerate(room.objects) if row not in gone]
    marks = {
        "given": list(range(len(placed))),
        "replaced": len(partners),
        "removed": len(clashing),
        "replaced_off_m": _mean_apart(room, given, partners),
        **extra,
    }
    objects = (*placed, *added)
    floor_m = room.floor_m if given.floor_m is None else given.floor_m
    return replace(room, objects=objects, floor_m=floor_m, extra=marks)


def _partners(room: Scene, given: Scene) -> dict[int, int]:
    """Maps the row of a given object to the row of the room's object that matches it."""
    pairs = {}
    for label in {item.label for item in given.objects}:
        ours, theirs = (
            [row for row, item in enumerate(scene.objects) if item.label == label]
            for scene in (room, given)
        )
        match = match_scenes(
            replace(room, objects=tuple(room.objects[row] for row in ours)),
            replace(given, objects=tuple(given.objects[row] for row in theirs)),
        )
        for a, b in zip(match.decoded, match.truth, strict=True):
            pairs[theirs[b]] = ours[a]
    return pairs


def _mean_apart(room: Scene, given: Scene, partners: dict[int, int]) -> float | None:
    if not partners:
        return None
    ours, theirs = (np.hstack([scene.centers_m, scene.sizes_m]) for scene in (room, given))
    apart = ours[list(partners.values())] - theirs[list(partners)]
    return round(float(np.abs(apart).mean()), 5)


def _with_mesh(item: SceneObject, lender: SceneObject) -> SceneObject:
    """A given object; if it has no mesh, it gets `lender`'s shape, scaled into its box."""
    if item.mesh is not None:
        return item
    lent = lender.in_box(item.center_m, item.size_m)
    return replace(item, mesh=lent.mesh, solids=lent.solids)

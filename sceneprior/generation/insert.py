"""Insert given objects into a room, in place of those that stand for them or are in their way."""

from dataclasses import replace
from typing import Any

import numpy as np

from sceneprior.evaluation.metrics.decoded_rooms import match_scenes
from sceneprior.evaluation.metrics.overlaps import shared_of_smaller
from sceneprior.scene import Scene, SceneObject

BADLY = 0.25
"""A room's own object goes where it shares more than this part of the smaller of the two volumes
with a given one. A chair pushed under a table may stay, a wardrobe in a bed may not."""


def insert(room: Scene, given: Scene, **extra: Any) -> Scene:
    """Given objects first and exactly as they came, then what the room adds to them.

    Of the room's own objects go

    - those that stand for a given one: of the same class, paired one to one by their boxes (see
      `match_scenes`); one lends its mesh to a given object that has none;
    - of the others, those that overlap a given one badly: `BADLY`.

    Args:
        room: Generated, or any other room.
        given: Objects, and perhaps a floor, which the result has too.
        extra: For the JSON, beside `given` (the rows of the given objects), `replaced` and
            `removed` (how many of the room's own objects went for which reason), and
            `replaced_off_m` (how far the first were from what they stand for, mean over centre
            and sides; null if none).
    """
    given = replace(given, label_set=room.label_set)
    partners = _partners(room, given)
    clashing = set(np.flatnonzero((shared_of_smaller(room, given) > BADLY).any(axis=1)).tolist())
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
    return replace(room, objects=objects, floor_m=given.floor_m, extra=marks)


def _partners(room: Scene, given: Scene) -> dict[int, int]:
    """Row of a given object -> row of the room's object that stands for it."""
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
    """A given object; where it has no mesh, with another's, moved and scaled into its box."""
    if item.mesh is not None:
        return item
    return replace(item, mesh=lender.in_box(item.center_m, item.size_m).mesh)

"""Checks of a request before rooms are drawn, and of its wishes in rooms that are drawn."""

import math
import warnings
from collections import Counter
from collections.abc import Collection, Sequence
from itertools import combinations, product
from typing import Any

import numpy as np
from jaxtyping import Float

from sceneprior.core.arrangements import findings, pieces_of
from sceneprior.core.classes import UnknownClassError
from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.scene import Opening, Scene, SceneObject
from sceneprior.core.scene_json import WALL_M
from sceneprior.core.shell import floor_polygon
from sceneprior.lifted.requests.floors import Floor, RoomShape
from sceneprior.lifted.requests.openings import USUAL_M, WantedOpening, walls_for
from sceneprior.lifted.requests.relations import Furniture, RelationChecks, footprints
from sceneprior.lifted.requests.wishes import OPENINGS, Conditions, CountWish

SHARED, NOTED = 0.5, 0.1
"""Shares of a given object's footprint outside the floor, or of the smaller of two boxes inside the
other, above which a request is refused and above which a note says so. Scenes of data sets have
small ones."""
BEYOND_M, ABOVE_M = 0.015, 1e-4
"""Distances by which drawn objects may extend beyond the floor and, since files round lengths,
beyond the ceiling."""
FAULTS = {
    "pairs_at_bed": "{1} and {2} do not stand at one end of the {0}, on its two sides",
    "chairs_at_tables": "{0} stands at no table",
    "chairs_turned": "{0} is not turned to its {1}",
    "tables_with_chairs": "{0} has no chair",
    "screens_seen": "{0} and the seats do not face each other",
    "fronts_free": "{0} has no free floor before its front",
    "backs_covered": "{0} has its back at no wall",
}
"""Words for failed checks of function."""


def check_request(
    asked: Conditions, known: Sequence[str], most: int, may_meet: Collection[frozenset[str]]
) -> None:
    """Reject a request that no room of a prior can meet.

    Args:
        known: Classes that the prior draws.
        most: Maximum number of objects in a room.
        may_meet: Pairs of classes whose boxes may intersect.

    Raises:
        InputError: a class is unknown, or two parts contradict each other; the message quotes both.
    """
    given = [item.label for item in asked.objects]
    there, total = Counter([*given, *(each.kind for each in asked.openings)]), 0
    for label in dict.fromkeys([*asked.wishes.needs, *there]):
        own, count = asked.wishes.needs.get(label, []), there[label]
        least = max((need.least for need in own), default=0)
        if label not in (*known, *OPENINGS) and (least > count or not count):
            raise UnknownClassError(label, known)
        names = [str(each) for each in asked.openings if isinstance(each, WantedOpening)]
        named = ", ".join(name for name in names if name.startswith(label))
        there_is = CountWish(label, count, said=named or f"{count} given {label}")
        for need, limit in product([*reversed(own), there_is], own):
            if limit.most is not None and need.least > limit.most:
                raise _contradiction(
                    f"'{need.said or need}', which needs {need.least} {label}",
                    f"'{limit.said or limit}', which allows {limit.most}",
                )
        total += given.count(label) if label in OPENINGS else max(least, count)
    if total > most:
        raise InputError(
            f"The given and the requested objects are {total} together, but rooms of this run "
            f"hold at most {most} (model.max_objects); ask for fewer."
        )
    _check_places(asked, known, may_meet)


def _check_places(
    asked: Conditions, known: Sequence[str], may_meet: Collection[frozenset[str]]
) -> None:
    """Reject given objects outside the floor, and objects, doors and windows that are above the
    ceiling or inside one another."""
    openings = [each for each in asked.openings if isinstance(each, Opening)]
    boxes_m = np.concatenate([boxes_of(asked.objects), *map(_box_of, openings)])
    labels = [each.label for each in asked.objects] + [each.kind for each in openings]
    said = [
        f"a given {label} at {x:.3g}, {y:.3g}, {z:.3g} m"
        for label, (x, y, z, *_) in zip(labels, boxes_m, strict=True)
    ]
    low_m, high_m = boxes_m[:, :3] - boxes_m[:, 3:] / 2, boxes_m[:, :3] + boxes_m[:, 3:] / 2
    if asked.floor is not None:
        low_x, low_z, high_x, high_z = asked.floor.polygon.bounds
        floor = f"a floor from {low_x:g} to {high_x:g} m in x and {low_z:g} to {high_z:g} m in z"
        for text, plan in zip(said, footprints(boxes_of(asked.objects)), strict=False):
            _compare(plan.difference(asked.floor.polygon).area / plan.area, "outside", text, floor)
    tops_m = [*zip(said, high_m[:, 1], strict=True)]
    wanted = [each for each in asked.openings if isinstance(each, WantedOpening)]
    tops_m += [(f"a {each.kind}", USUAL_M[each.kind][2]) for each in wanted]
    for text, top_m in tops_m:
        if top_m > (asked.ceiling_m or math.inf) + WALL_M:
            raise _contradiction(
                f"{text}, which is {top_m:g} m high", f"a ceiling of {asked.ceiling_m:g} m"
            )
    for one, other in combinations(range(len(said)), 2):
        pair = {labels[one], labels[other]}
        objects = [row < len(asked.objects) for row in (one, other)]
        if any(objects) and (not all(objects) or not pair <= {*known} or pair in may_meet):
            continue
        ends_m = np.minimum(high_m[one], high_m[other]) - np.maximum(low_m[one], low_m[other])
        share = ends_m.clip(min=0).prod() / boxes_m[[one, other], 3:].prod(axis=1).min()
        _compare(share, "inside the other", said[one], said[other])


def _compare(share: float, where: str, one: str, other: str) -> None:
    """Reject a share above `SHARED`, and say if it is above `NOTED`."""
    if share > SHARED:
        raise _contradiction(one, f"{other}, of which one is {share:.0%} {where}")
    if share > NOTED:
        text = f"The request has {one}, {share:.0%} {where} ({other}); it stays as it is."
        warnings.warn(text, InputWarning, stacklevel=2)


def _contradiction(one: str, other: str) -> InputError:
    return InputError(f"The request has {one}, and {other}; change one of them.")


def answers(
    scene: Scene, asked: Conditions, front: Float[np.ndarray, "objects 2"]
) -> list[dict[str, Any]]:
    """Each wish, and whether it holds in a scene, `implied` ones included (`Wishes.implied`); then
    other requested openings, the floor and the ceiling.

    Args:
        front: Unit vectors (x, z) of the fronts of objects without a yaw.
    """
    boxes_m, wishes = boxes_of(scene.objects), asked.wishes
    index = np.array([asked.classes.index(item.label) for item in scene.objects], dtype=np.int64)
    fronts = fronts_of(scene.objects)
    furniture = Furniture(boxes_m, index, 0 * index, np.where(np.isnan(fronts), front, fronts))
    counts = Counter(item.label for item in scene.objects if item.label not in OPENINGS)
    counts += Counter(each.kind for each in scene.openings)
    found = [(str(wish), wish.holds(counts[wish.label])) for wish in wishes.counts]
    if scene.floor_m is not None:
        floor = Floor(scene.floor_m)
        relations = (*wishes.relations, *wishes.implied)
        checks = RelationChecks(relations, RoomShape(floor, scene.openings), asked.classes)
        found += zip(map(str, relations), checks.held(furniture), strict=True)
        for each in asked.openings:
            plain = WantedOpening(each.kind)
            if each != plain or each.kind not in wishes.needs:
                text = str(each) if isinstance(each, WantedOpening) else f"{each.kind} as given"
                found.append((text, any(_is(each, placed, floor) for placed in scene.openings)))
    new, added = boxes_m[len(asked.objects) :], " added" * bool(asked.objects)
    if asked.floor is not None:
        on = asked.floor.polygon.buffer(BEYOND_M, join_style="mitre").covers(footprints(new)).all()
        same = np.array_equal(scene.floor_m, asked.floor.outline_m)  # type: ignore[arg-type]
        width_m, depth_m = asked.floor.rectangle_m[2:]
        found.append((f"all{added} on the floor of {width_m:g} x {depth_m:g} m", bool(on and same)))
    if asked.ceiling_m is not None:
        below = (new[:, 1] + new[:, 4] / 2 <= asked.ceiling_m + ABOVE_M).all()
        found.append((f"all{added} below the ceiling of {asked.ceiling_m:g} m", bool(below)))
    implied = {str(wish) for wish in wishes.implied}
    return [
        {"wish": text, "holds": holds} | ({"implied": True} if text in implied else {})
        for text, holds in found
    ]


def remarks(scene: Scene) -> list[str]:
    """Faults of function in a room (`core/arrangements.py`), in words."""
    labels = [item.label for item in scene.objects]
    names = [
        f"{label} {labels[:row].count(label) + 1}" if labels.count(label) > 1 else label
        for row, label in enumerate(labels)
    ]
    return [
        FAULTS[check].format(*(names[row].replace("_", " ") for row in each.rows))
        for check, found in findings(pieces_of(scene), floor_polygon(scene)).items()
        for each in found
        if not each.holds
    ]


def _is(wanted: Opening | WantedOpening, placed: Opening, floor: Floor) -> bool:
    """True if a door or a window in a room is a requested one."""
    if isinstance(wanted, Opening) or wanted.kind != placed.kind:
        return wanted == placed
    middle_m = np.mean([placed.start_m, placed.end_m], axis=0)
    return any(
        wall.distance_m(middle_m) < WALL_M
        for wall in walls_for(wanted, floor.walls)
        if wanted.at_m is None
        or abs((middle_m - wall.start_m) @ wall.direction - wanted.at_m) < WALL_M
    )


def boxes_of(objects: Sequence[SceneObject]) -> Float[np.ndarray, "objects 6"]:
    """Boxes of objects: centre and full extents."""
    return np.array([[*item.center_m, *item.size_m] for item in objects]).reshape(-1, 6)


def _box_of(opening: Opening) -> Float[np.ndarray, "1 6"]:
    """Box of a door or window, as thick as it may be off its wall."""
    (x, z), (to_x, to_z), low, high = opening[1:]
    size = max(abs(x - to_x), WALL_M), high - low, max(abs(z - to_z), WALL_M)
    return np.array([[(x + to_x) / 2, (low + high) / 2, (z + to_z) / 2, *size]])


def fronts_of(objects: Sequence[SceneObject]) -> Float[np.ndarray, "objects 2"]:
    """Unit vectors (x, z) along which objects with a yaw face; NaN for others."""
    yaws = np.array([item.turned.yaw_rad if item.turned else np.nan for item in objects])
    return np.stack([np.sin(yaws), np.cos(yaws)], axis=1)

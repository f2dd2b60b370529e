"""Scenes from a run's sampler: plain rooms, requested rooms, and the rest of given ones."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from sceneprior.core.classes import label_set, unknown_class
from sceneprior.core.errors import InputError
from sceneprior.core.repeatable import single_threaded
from sceneprior.core.scene import Mesh, Scene, SceneObject, Solid, quarter_turned
from sceneprior.core.shell import rectangle
from sceneprior.lifted.config import SAMPLER, TrainedLifted
from sceneprior.lifted.drawing.draw import SampledRooms, draw_rooms
from sceneprior.lifted.lifting import HANGS_M
from sceneprior.lifted.prototype_decoder import PrototypeDecoder
from sceneprior.lifted.prototypes import POSES, PosedRooms
from sceneprior.lifted.requests.relations import RelationChecks, furniture_in
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.lifted.requests.wishes import Conditions
from sceneprior.lifted.sampler.frames import side_of
from sceneprior.paper.prior import TrainedPrior


def drawn_by_sampler(trained: TrainedPrior, distribution: str | None) -> TrainedLifted | None:
    """Return `trained` if its sampler draws new rooms; None if new rooms come from latents.

    This is decided by `distribution`, or by the run's own settings if `distribution` is None.

    Raises:
        InputError: the sampler should draw, but the run has none, or none yet.
    """
    if (distribution or trained.distribution) != SAMPLER:
        return None
    if not isinstance(trained, TrainedLifted) or trained.sampler is None:
        raise InputError(
            "This run has no sampler, or its stage has not begun; leave out --distribution "
            f"{SAMPLER}, or train with a section `sampler` (`--config lifted/bedroom.yaml`)."
        )
    return trained


@single_threaded()
def sample_scenes(
    trained: TrainedLifted,
    names: Sequence[str],
    seed: int,
    request: RoomRequest | None = None,
    classes: Sequence[str] | None = None,
    floor_stays: bool = False,
) -> list[Scene]:
    """Sample a room with meshes for each name; see `draw_rooms`.

    `extra` of a room lists the rows of the given objects (`given`), the request without them
    (`request`), and whether each wish holds (`wishes`).

    Args:
        classes: Classes of the objects to add to the given ones, and no others; instead of wishes.
            `extra["no_place"]` lists those for which no place was found.
        floor_stays: Never move the floor; otherwise, a floor without given objects is centred.

    Raises:
        InputError: the prior does not understand the request, or no room meets it.
    """
    sampler = trained.sampler
    assert sampler is not None, "callers ask trained.sampler first"
    request, label_names = request or RoomRequest(), label_set(trained.config.label_set)
    known = [label_names[row] for row in sampler.drawn_classes]
    if classes is not None:
        for label in classes:
            if label not in known:
                raise unknown_class(label, known)
        whole = Counter(classes) + Counter(item.label for item in request.objects)
        want = {label: whole[label] for label in known}
        request = RoomRequest(**{**request.parts(), "want": want})
    labels, most = trained.config.label_set, sampler.max_objects
    conditions = request.conditions(known, labels, most, floor_stays)
    drawn = draw_rooms(sampler, conditions, len(names), seed, may_lack=classes is not None)
    told = {key: part for key, part in request.parts().items() if key != "objects"}
    scenes = []
    for row, name in enumerate(names):
        scene = scene_of(trained, name, drawn.rooms, row)
        extra: dict[str, Any] = {}
        if classes is not None:
            extra["no_place"] = sorted(label_names[index] for index in drawn.missing[row])
        elif told:
            extra = {"request": told, "wishes": _wishes(trained, conditions, drawn, row)}
        scenes.append(_as_requested(scene, conditions, drawn, row, extra))
    return scenes


def _wishes(
    trained: TrainedLifted, conditions: Conditions, drawn: SampledRooms, row: int
) -> list[dict[str, Any]]:
    """Each wish, and whether it holds in a room."""
    assert trained.sampler is not None
    furniture = furniture_in(trained.sampler, drawn.rooms, row)
    counts = Counter(conditions.classes[index] for index in furniture.object_class)
    wishes = conditions.wishes
    held = [wish.holds(counts[wish.label]) for wish in wishes.counts]
    if (shape := drawn.shapes[row]) is not None:
        held += RelationChecks(wishes.relations, shape, conditions.classes).held(furniture)
    return [
        {"wish": str(wish), "holds": holds}
        for wish, holds in zip((*wishes.counts, *wishes.relations), held, strict=True)
    ]


def _as_requested(
    scene: Scene, conditions: Conditions, drawn: SampledRooms, row: int, extra: dict[str, Any]
) -> Scene:
    """A scene with the given objects as they are; those without a mesh get that of their look."""
    given = conditions.objects
    if given:
        extra["given"] = list(range(len(given)))
    objects = tuple(
        replace(own, mesh=looked.mesh, solids=looked.solids) if own.mesh is None else own
        for own, looked in zip(given, scene.objects, strict=False)
    )
    scene = replace(scene, objects=objects + scene.objects[len(given) :], extra=extra)
    if (shape := drawn.shapes[row]) is None:
        return scene
    return replace(
        scene,
        floor_m=shape.floor.outline_m,
        openings=shape.openings,
        ceiling_m=shape.ceiling_m,
    )


def scene_of(trained: TrainedLifted, name: str, rooms: PosedRooms, row: int) -> Scene:
    """Convert a sampled room to a scene with meshes; its floor is the room's rectangle, if known.

    Yaws of objects are those of the fronts of their looks (`find_sides`).
    """
    sampler, shapes = trained.sampler, trained.prior.shape
    assert sampler is not None, "callers ask trained.sampler first"
    assert isinstance(shapes, PrototypeDecoder), "whose looks the sampler draws"
    assert rooms.looks is not None
    classes = label_set(trained.config.label_set)
    fronts = side_of(rooms.looks[row], sampler.fronts)
    confidence = sampler.front_confidence[rooms.looks[row] // POSES]
    objects = []
    for item in rooms.is_object[row].nonzero()[:, 0].tolist():
        box = rooms.boxes_m[row, item].double().numpy()
        look, index = int(rooms.looks[row, item]), int(rooms.object_class[row, item])
        # A given object whose class has no prototype gets no mesh.
        known = int(sampler.look_class[look]) == index
        if box[1] - box[4] / 2 < HANGS_M:
            box[1] = box[4] / 2  # lifted boxes end a little above the floor
        mesh, solids = _shape_in(shapes, look, box) if known else (None, ())
        label = classes[index]
        center, size = tuple(box[:3]), tuple(box[3:])
        # A front at high z, high x, low z or low x is turned by 0, 1, 2 or 3 quarters.
        turned = quarter_turned(size, int(fronts[item]) + 2)._replace(
            confidence=float(confidence[item])
        )
        objects.append(SceneObject(label, center, size, mesh, turned if known else None, solids))
    floor_m = None
    if rooms.rectangle_m is not None:
        middle, extents = rooms.rectangle_m[row].double().numpy().reshape(2, 2)
        floor_m = rectangle(middle - extents / 2, middle + extents / 2).round(3)
    return Scene(name, trained.config.label_set, tuple(objects), floor_m)


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

"""Samples requested rooms as scenes, each with the list of wishes and whether they hold."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.repeatable import check_seed, single_threaded
from sceneprior.core.scene import Opening, Scene
from sceneprior.lifted.config import TrainedLifted
from sceneprior.lifted.requests.draw import Answer, draw_requested
from sceneprior.lifted.requests.relations import RelationChecks, furniture_in
from sceneprior.lifted.requests.request import Conditions, RoomRequest
from sceneprior.lifted.sampled import drawn_by_sampler, scene_of
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import scene_names


@single_threaded()
def sample_requested(
    trained: TrainedPrior,
    asked: Mapping[str, Any],
    count: int,
    seed: int,
    distribution: str | None = None,
    name: str | None = None,
) -> list[Scene]:
    """Sample rooms that meet a request, with a run's sampler.

    Args:
        asked: Arguments of `make_request`: floor, openings, ceiling_m, want and objects.
        name: Prefix of the rooms' names; None names the rooms by the seed.

    Raises:
        InputError: the run has no sampler, or no room meets the request.
    """
    check_seed(seed)
    with_sampler = drawn_by_sampler(trained, distribution)
    if with_sampler is None:
        raise InputError(
            "Requests for floors and wishes need a sampler, but these rooms come from latents; "
            "leave them out, or take a prior with a sampler."
        )
    assert with_sampler.sampler is not None, "checked by drawn_by_sampler"
    classes = label_set(with_sampler.config.label_set)
    known = [classes[row] for row in with_sampler.sampler.drawn_classes]
    request = RoomRequest.of(**asked).conditions(known, with_sampler.config.label_set)
    answers = draw_requested(with_sampler.sampler, request, classes, count, seed)
    names = scene_names(count, seed)
    if name is not None:
        names = [f"{name}_{row:02d}" for row in range(count)]
    return [
        _scene(with_sampler, name, answer, request, asked)
        for name, answer in zip(names, answers, strict=True)
    ]


def _told(value: Any) -> Any:
    """Convert part of a request to plain JSON data: corners, openings and wishes as given."""
    if isinstance(value, Opening):
        return _told(value._asdict())
    if isinstance(value, Mapping):
        return {str(key): _told(each) for key, each in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_told(each) for each in value]
    return value if isinstance(value, str | float | int | bool | None) else str(value)


def _scene(
    trained: TrainedLifted, name: str, answer: Answer, request: Conditions, asked: Mapping[str, Any]
) -> Scene:
    scene = scene_of(trained, name, answer.room, 0)
    counts = Counter(item.label for item in scene.objects)
    shape = answer.plan.shape
    relations = RelationChecks(request.wishes.relations, shape, label_set(scene.label_set))
    assert trained.sampler is not None, "the sampler drew the answer"
    held = relations.held(furniture_in(trained.sampler, answer.room, 0))
    wishes = [
        {"wish": str(wish), "holds": wish.holds(counts[wish.label])}
        for wish in request.wishes.counts
    ]
    wishes += [
        {"wish": str(wish), "holds": holds}
        for wish, holds in zip(request.wishes.relations, held, strict=True)
    ]
    given = request.objects
    return replace(
        scene,
        objects=tuple(
            # Given objects stay as they are; those without a mesh get the mesh of their look.
            replace(own, mesh=drawn.mesh, solids=drawn.solids) if own.mesh is None else own
            for own, drawn in zip(given, scene.objects, strict=False)
        )
        + scene.objects[len(given) :],
        floor_m=shape.floor.outline_m,
        openings=shape.openings,
        ceiling_m=shape.ceiling_m,
        extra={
            "request": {key: _told(value) for key, value in asked.items() if key != "objects"},
            "wishes": wishes,
            **({"given": list(range(len(given)))} if given else {}),
        },
    )

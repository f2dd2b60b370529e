"""Requested rooms as scenes, each with the wishes that hold in it."""

from collections import Counter
from dataclasses import replace

from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.core.seeds import check_seed
from sceneprior.core.threads import single_threaded
from sceneprior.lifted.requests.draw import Answer, draw_requested
from sceneprior.lifted.requests.request import Request
from sceneprior.lifted.sampled import drawn_by_sampler, scene_of
from sceneprior.lifted.trained import TrainedLifted
from sceneprior.paper.sampling import scene_names
from sceneprior.paper.trained import TrainedPrior


@single_threaded()
def sample_requested(
    trained: TrainedPrior, request: Request, count: int, seed: int, distribution: str | None = None
) -> list[Scene]:
    """New rooms as requested, drawn by a run's sampler.

    Raises:
        InputError: the run has no sampler, or no room holds the request.
    """
    check_seed(seed)
    with_sampler = drawn_by_sampler(trained, distribution)
    if with_sampler is None:
        raise InputError(
            "Floors and wishes can be asked of a sampler alone, and these rooms come from latents; "
            "leave them out, or take a prior with a sampler."
        )
    assert with_sampler.sampler is not None, "drawn_by_sampler has asked"
    classes = label_set(with_sampler.config.label_set)
    answers = draw_requested(with_sampler.sampler, request, classes, count, seed)
    names = scene_names(count, seed)
    return [
        _scene(with_sampler, name, answer, request)
        for name, answer in zip(names, answers, strict=True)
    ]


def _scene(trained: TrainedLifted, name: str, answer: Answer, request: Request) -> Scene:
    scene = scene_of(trained, name, answer.room, 0)
    counts = Counter(item.label for item in scene.objects)
    wishes = [
        {"wish": str(wish), "holds": wish.holds(counts[wish.label])}
        for wish in request.wishes.counts
    ]
    shape = answer.plan.shape
    return replace(
        scene,
        floor_m=shape.outline_m,
        openings=shape.openings,
        ceiling_m=shape.ceiling_m,
        extra={"wishes": wishes},
    )

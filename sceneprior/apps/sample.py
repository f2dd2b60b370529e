"""Sampling of new rooms from a run of any method."""

from collections.abc import Sequence

from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.repeatable import check_seed, single_threaded
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.views import RoomBoxes
from sceneprior.lifted.config import SAMPLER, TrainedLifted
from sceneprior.lifted.drawing.scenes import drawn_by_sampler, sample_scenes
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import decode_latents, draw_latents, scene_names
from sceneprior.training.method import Trained, TrainedReconstructor


@single_threaded()
def sample_rooms(
    trained: Trained,
    count: int,
    seed: int,
    distribution: str | None = None,
    request: RoomRequest | None = None,
    completes: bool = False,
    classes: Sequence[str] | None = None,
) -> list[Scene]:
    """Sample new rooms from a run of any method, by its sampler or a distribution of latents.

    The same seed gives the same rooms; without a distribution, the run's default is used.

    Args:
        request: What the rooms must meet; only a sampler can.
        completes: Complete the room of the request, whose floor stays where it is, by the run's
            sampler, whatever its default.
        classes: See `sample_scenes`.

    Raises:
        InputError: the run cannot draw such rooms.
    """
    if isinstance(trained, TrainedReconstructor):
        raise InputError(
            f"`method: {trained.config.method}` reconstructs images and makes no new rooms; use "
            "`sceneprior reconstruct` or `eval-svr`, or a run of another method."
        )
    check_seed(seed)
    names = scene_names(count, seed)
    if completes:
        names = [f"complete_{row:02d}" for row in range(count)]
        if isinstance(trained, TrainedLifted) and trained.sampler is not None:
            distribution = SAMPLER
    own = drawn_by_sampler(trained, distribution) if isinstance(trained, TrainedPrior) else None
    if own is not None:
        return sample_scenes(own, names, seed, request, classes, floor_stays=completes)
    if request is not None or classes is not None:
        others = "these rooms come from latents"
        if not isinstance(trained, TrainedPrior):
            others = f"`method: {trained.config.method}` has none"
        raise InputError(
            f"Floors, wishes and given objects need a sampler, but {others}; leave them out, or "
            "take a prior with a sampler."
        )
    if isinstance(trained, TrainedPrior):
        z = draw_latents(trained, count, seed, distribution)
        return decode_latents(trained, z, names)
    if distribution is not None:
        raise InputError(
            f"--distribution {distribution} chooses a distribution of latents, but `method: "
            f"{trained.config.method}` has no latents; leave the option out."
        )
    rooms = trained.prior.sample(count, seed)
    return boxes_to_scenes(rooms, trained.config.label_set, names)


def boxes_to_scenes(rooms: RoomBoxes, label_set_name: str, names: Sequence[str]) -> list[Scene]:
    """Scenes of boxes without meshes; `extra` holds the objects' yaws, if they are known."""
    classes = label_set(label_set_name)
    scenes = []
    for row, name in enumerate(names):
        real = rooms.is_object[row]
        labels, boxes = rooms.object_class[row, real].tolist(), rooms.boxes_m[row, real].tolist()
        objects = tuple(
            SceneObject(classes[label], tuple(box[:3]), tuple(box[3:]))
            for label, box in zip(labels, boxes, strict=True)
        )
        yaw_rad = rooms.yaw_rad
        extra = {} if yaw_rad is None else {"yaw_rad": yaw_rad[row, real].tolist()}
        scenes.append(Scene(name, label_set_name, objects, extra=extra))
    return scenes

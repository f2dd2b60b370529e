"""Rooms of a run's sampler as scenes: each object's look becomes a mesh in its box."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.classes import label_set
from sceneprior.errors import InputError
from sceneprior.evaluation.networks import single_threaded
from sceneprior.models.occupancy import OccupancyDecoder
from sceneprior.sampler.draw import draw_rooms
from sceneprior.sampler.plan import Given
from sceneprior.scene import Scene, SceneObject
from sceneprior.training.method import TrainedPrior
from sceneprior.views import RoomBoxes


@single_threaded()
def sample_scenes(
    trained: TrainedPrior, names: Sequence[str], seed: int, given: Given | None = None
) -> list[Scene]:
    """One new room a name, with meshes; see `draw_rooms`."""
    assert trained.sampler is not None, "callers ask trained.sampler first"
    rooms = draw_rooms(trained.sampler, len(names), seed, given)
    return looks_to_scenes(trained, rooms, names)


def looks_to_scenes(trained: TrainedPrior, rooms: RoomBoxes, names: Sequence[str]) -> list[Scene]:
    """Rooms of objects that have looks, as the run's shape decoder makes them."""
    assert rooms.looks is not None and trained.sampler is not None
    shapes = trained.prior.shape
    assert isinstance(shapes, OccupancyDecoder), "whose looks the sampler draws"
    classes = label_set(trained.config.label_set)
    scenes = []
    for row, name in enumerate(names):
        objects = []
        for item in rooms.is_object[row].nonzero()[:, 0].tolist():
            box = rooms.boxes_m[row, item].double().numpy()
            look, index = int(rooms.looks[row, item]), int(rooms.object_class[row, item])
            # A given object may be of a class that has no look, and then it has no shape.
            known = int(trained.sampler.look_class[look]) == index
            mesh = shapes.mesh(look, box) if known else None
            label = classes[index]
            objects.append(SceneObject(label, tuple(box[:3]), tuple(box[3:]), mesh))
        scenes.append(Scene(name, trained.config.label_set, tuple(objects)))
    return scenes


def class_rows(trained: TrainedPrior, labels: Sequence[str]) -> Int[Tensor, "1 labels"]:
    """Classes by name, as `Given.coming` takes them; an `InputError` for one that the sampler has
    never seen."""
    assert trained.sampler is not None
    classes = label_set(trained.config.label_set)
    looks = trained.sampler.look_class
    known = [classes[row] for row in looks[looks >= 0].unique().tolist()]
    for label in labels:
        if label not in known:
            raise InputError(
                f"'{label}' is no class of this run's training rooms; choose from "
                f"{', '.join(known)}."
            )
    return torch.tensor([[classes.index(label) for label in labels]], dtype=torch.int64)


def floor_rectangle(scene: Scene) -> Float[Tensor, "1 4"]:
    """The rectangle round a scene's floor: centre x, z and extents x, z."""
    assert scene.floor_m is not None
    low, high = scene.floor_m.min(axis=0), scene.floor_m.max(axis=0)
    return torch.from_numpy(np.concatenate([(low + high) / 2, high - low])[None]).float()

"""Scenes from a run's sampler: each object's look becomes a mesh in its box."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.core.classes import label_set, unknown_class
from sceneprior.core.errors import InputError
from sceneprior.core.outline import rectangle
from sceneprior.core.repeatable import single_threaded
from sceneprior.core.scene import Mesh, Scene, SceneObject, Solid, quarter_turned
from sceneprior.lifted.config import SAMPLER, TrainedLifted
from sceneprior.lifted.lifting import HANGS_M
from sceneprior.lifted.prototype_decoder import PrototypeDecoder
from sceneprior.lifted.prototypes import POSES
from sceneprior.lifted.rooms import PosedRooms
from sceneprior.lifted.sampler.draw import draw_rooms
from sceneprior.lifted.sampler.frames import side_of
from sceneprior.lifted.sampler.plan import Given
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
    trained: TrainedLifted, names: Sequence[str], seed: int, given: Given | None = None
) -> list[Scene]:
    """Sample a room with meshes for each name; see `draw_rooms`."""
    assert trained.sampler is not None, "callers ask trained.sampler first"
    rooms = draw_rooms(trained.sampler, len(names), seed, given)
    return [scene_of(trained, name, rooms, row) for row, name in enumerate(names)]


def scene_of(trained: TrainedLifted, name: str, rooms: PosedRooms, row: int) -> Scene:
    """Convert a sampled room to a scene with meshes; its floor is the room's rectangle, if known.

    Yaws of objects are those of the fronts of their looks (`lifted/sampler/fronts.py`).
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


def class_rows(trained: TrainedLifted, labels: Sequence[str]) -> Int[Tensor, "1 labels"]:
    """Indices of named classes, as in `Given.coming`.

    Raises:
        InputError: a class is not in the training rooms.
    """
    assert trained.sampler is not None
    classes = label_set(trained.config.label_set)
    known = [classes[row] for row in trained.sampler.drawn_classes]
    for label in labels:
        if label not in known:
            raise unknown_class(label, known)
    return torch.tensor([[classes.index(label) for label in labels]], dtype=torch.int64)


def floor_rectangle(scene: Scene) -> Float[Tensor, "1 4"]:
    """The bounding rectangle of a scene's floor: centre x, z and extents x, z."""
    assert scene.floor_m is not None
    low, high = scene.floor_m.min(axis=0), scene.floor_m.max(axis=0)
    return torch.from_numpy(np.concatenate([(low + high) / 2, high - low])[None]).float()

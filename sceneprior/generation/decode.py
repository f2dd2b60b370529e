"""Decode latents into scenes, of training rooms and of new ones; new rooms of every method."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.classes import VOID, label_set
from sceneprior.errors import InputError
from sceneprior.evaluation.networks import single_threaded
from sceneprior.generation.sample import draw_latents, scene_names, uses_sampler
from sceneprior.generation.sampled import sample_scenes
from sceneprior.losses.completeness import kept_objects
from sceneprior.models.occupancy import OccupancyDecoder
from sceneprior.models.prior import ScenePrior
from sceneprior.scene import Mesh, Scene, SceneObject
from sceneprior.training.method import Trained, TrainedPrior, TrainedReconstructor
from sceneprior.views import DecodedScenes, RoomBoxes

BATCH = 64


class DecodedRoom(NamedTuple):
    """A decoded scene, and what the network said of each of its objects."""

    scene: Scene
    predictions: list[int]
    """Which of the network's N predictions each object is."""
    class_logits: Float[Tensor, "objects classes"]


def to_rooms(
    decoded: DecodedScenes,
    prior: ScenePrior,
    label_set_name: str,
    names: Sequence[str],
    completeness_target: str = "first_n",
) -> list[DecodedRoom]:
    """Objects up to where completeness says that the scene ends; their likeliest classes.

    `void` is a class like any other to the network, but no furniture: such objects are left out.
    `prior` is what decoded them.
    """
    kept = kept_objects(decoded.completeness_logits, completeness_target)
    kept = kept & (decoded.class_logits.argmax(dim=-1) != VOID)
    rooms = []
    for row, name in enumerate(names):
        predictions = kept[row].nonzero()[:, 0].tolist()
        scene = scene_of(decoded, row, predictions, prior, label_set_name, name)
        rooms.append(DecodedRoom(scene, predictions, decoded.class_logits[row, predictions]))
    return rooms


def scene_of(
    decoded: DecodedScenes,
    row: int,
    predictions: Sequence[int],
    prior: ScenePrior,
    label_set_name: str,
    name: str,
) -> Scene:
    """Some predictions for one room as a scene, in the given order; their likeliest classes but
    void, meshes where shapes were decoded."""
    classes = label_set(label_set_name)
    objects = []
    for item in predictions:
        logits = decoded.class_logits[row, item].clone()
        logits[VOID] = -torch.inf
        center, size = (part[row, item].tolist() for part in (decoded.centers_m, decoded.sizes_m))
        mesh = _mesh_of(decoded, row, item, prior)
        objects.append(SceneObject(classes[int(logits.argmax())], tuple(center), tuple(size), mesh))
    return Scene(name, label_set_name, tuple(objects))


def _mesh_of(decoded: DecodedScenes, row: int, item: int, prior: ScenePrior) -> Mesh | None:
    """A prediction's mesh: as decoded, or that of its look; None before the shape stage."""
    if decoded.vertices_m is not None and prior.faces is not None:
        return Mesh(decoded.vertices_m[row, item].cpu().numpy(), prior.faces.cpu().numpy())
    if decoded.looks is None:
        return None
    assert isinstance(prior.shape, OccupancyDecoder), "looks are what it decodes"
    parts = (decoded.centers_m[row, item], decoded.sizes_m[row, item])
    return prior.shape.mesh(int(decoded.looks[row, item]), torch.cat(parts).double().cpu().numpy())


@single_threaded()
@torch.no_grad()
def decode_rooms(
    trained: TrainedPrior, z: Float[Tensor, "rooms width"], names: Sequence[str]
) -> list[DecodedRoom]:
    """Rooms of latents; with meshes once the shape stage has finished. Networks are too small for
    several threads to share, and on one the same latents are the same rooms to the bit."""
    config = trained.config
    rooms: list[DecodedRoom] = []
    for start in range(0, len(z), BATCH):
        part = slice(start, start + BATCH)
        decoded = trained.prior.decode(z[part], with_shape=trained.stage != "layout")
        target = config.model.completeness_target
        rooms += to_rooms(decoded, trained.prior, config.label_set, names[part], target)
    return [
        room._replace(scene=replace(room.scene, latent=point.cpu().numpy()))
        for room, point in zip(rooms, z, strict=True)
    ]


def decode_latents(
    trained: TrainedPrior, z: Float[Tensor, "rooms width"], names: Sequence[str]
) -> list[Scene]:
    """The scenes of `decode_rooms`."""
    return [room.scene for room in decode_rooms(trained, z, names)]


def decode_training_rooms(trained: Trained) -> list[Scene]:
    """The training rooms as the prior remembers them, named by their ids; an `InputError` for runs
    that keep no latents of them."""
    if not isinstance(trained, TrainedPrior) or not trained.remembers_rooms:
        raise InputError(
            f"A run of `method: {trained.config.method}` keeps no latents of training rooms, so "
            "none can be decoded; take a run of `method: ours`."
        )
    return decode_latents(trained, trained.prior.latent_space(trained.logits), trained.room_ids)


@single_threaded()
def synthesize(
    trained: Trained, count: int, seed: int, distribution: str | None = None
) -> list[Scene]:
    """New rooms of a run of any kind; the same seed, the same rooms.

    `distribution` says where they come from: `sampler`, or a distribution of latents; None takes
    the run's own. It is an `InputError` for a method that has neither, or that makes no rooms.
    """
    if isinstance(trained, TrainedReconstructor):
        raise InputError(
            f"`method: {trained.config.method}` answers images and makes no new rooms; use "
            "`sceneprior reconstruct` or `eval-svr`, or a run of another method."
        )
    names = scene_names(count, seed)
    if isinstance(trained, TrainedPrior):
        if uses_sampler(trained, distribution):
            return sample_scenes(trained, names, seed)
        z, _ = draw_latents(trained, count, seed, distribution)
        return decode_latents(trained, z, names)
    if distribution is not None:
        raise InputError(
            f"A distribution says where latents of rooms come from, but `method: "
            f"{trained.config.method}` has none; leave out --distribution {distribution}."
        )
    rooms = trained.prior.sample(count, seed)
    return boxes_to_scenes(rooms, trained.config.label_set, names)


def boxes_to_scenes(rooms: RoomBoxes, label_set_name: str, names: Sequence[str]) -> list[Scene]:
    """Objects that have no mesh; they are drawn as boxes. Yaws, where known, are in `extra`."""
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

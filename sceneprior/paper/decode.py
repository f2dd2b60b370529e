"""Decode latents into scenes."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneprior.core.classes import VOID, label_set
from sceneprior.core.repeatable import single_threaded
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.views import DecodedScenes
from sceneprior.paper.losses import kept_objects
from sceneprior.paper.prior import ScenePrior, TrainedPrior, with_training_latents
from sceneprior.training.method import Trained

BATCH = 64
"""Rooms decoded at a time."""


class DecodedRoom(NamedTuple):
    """A decoded scene, with the predictions that its objects come from and their class logits."""

    scene: Scene
    predictions: list[int]
    """Index of each object's prediction among the network's N."""
    class_logits: Float[Tensor, "objects classes"]


def kept_predictions(decoded: DecodedScenes, target: str) -> Bool[Tensor, "rooms objects"]:
    """True for predictions that are objects: the completeness scores keep them, and their most
    likely class is not `void`."""
    kept = kept_objects(decoded.completeness_logits, target)
    return kept & (decoded.class_logits.argmax(dim=-1) != VOID)


def to_rooms(
    decoded: DecodedScenes,
    prior: ScenePrior,
    label_set_name: str,
    names: Sequence[str],
    completeness_target: str = "first_n",
) -> list[DecodedRoom]:
    """Convert decoded rooms to scenes of their `kept_predictions`, with their most likely classes.

    `prior` is the network that decoded the rooms.
    """
    kept = kept_predictions(decoded, completeness_target)
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
    """A scene of the given predictions of one room, in the given order.

    An object has its most likely class other than void, and a mesh if shapes were decoded.
    """
    classes = label_set(label_set_name)
    objects = []
    for item in predictions:
        logits = decoded.class_logits[row, item].clone()
        logits[VOID] = -torch.inf
        center, size = (part[row, item].tolist() for part in (decoded.centers_m, decoded.sizes_m))
        mesh = prior.shape.mesh_of(decoded, row, item)
        solids = prior.shape.solids_of(decoded, row, item)
        label = classes[int(logits.argmax())]
        objects.append(SceneObject(label, tuple(center), tuple(size), mesh, solids=solids))
    return Scene(name, label_set_name, tuple(objects))


@single_threaded()
@torch.no_grad()
def decode_rooms(
    trained: TrainedPrior,
    z: Float[Tensor, "rooms width"],
    names: Sequence[str],
    reshaped: Callable[[DecodedScenes, slice], DecodedScenes] = lambda decoded, rows: decoded,
) -> list[DecodedRoom]:
    """Decode latents into rooms, with meshes unless the run has only trained its layout stage.

    `reshaped` may change the shapes of some of the rooms before they become scenes.

    Decoding runs on one thread: the networks are too small to gain from several, and on one thread
    equal latents give bit-identical rooms.
    """
    config = trained.config
    rooms: list[DecodedRoom] = []
    for start in range(0, len(z), BATCH):
        part = slice(start, start + BATCH)
        decoded = trained.prior.decode(z[part], with_shape=trained.stage != "layout")
        target = config.model.completeness_target
        decoded = reshaped(decoded, part)
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
    """Decode the training rooms from their own latents; a scene's name is the room's id.

    Raises:
        InputError: the run keeps no latents of its training rooms.
    """
    prior = with_training_latents(trained, "Decoding training rooms")
    return decode_latents(prior, prior.prior.latent_space(prior.logits), prior.room_ids)

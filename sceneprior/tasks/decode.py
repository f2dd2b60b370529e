"""Decoded batches in, single `Scene`s out; latents of training rooms and new ones."""

import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.batches import DecodedScenes
from sceneprior.classes import label_set
from sceneprior.errors import InputError
from sceneprior.losses.completeness import kept_objects
from sceneprior.scene import Mesh, Scene, SceneObject
from sceneprior.stages.runs import TrainedPrior
from sceneprior.tasks.sampling import sample_latents

BATCH = 64


def to_scenes(
    decoded: DecodedScenes,
    faces: Tensor,
    label_set_name: str,
    names: list[str],
    completeness_target: str = "first_n",
) -> list[Scene]:
    """Objects up to where completeness says that the scene ends; their likeliest classes.

    `void` is a class like any other to the network, but no furniture: such objects are left out.
    """
    classes = label_set(label_set_name)
    kept = kept_objects(decoded.completeness_logits, completeness_target)
    labels = decoded.class_logits.argmax(dim=-1)
    corners = faces.cpu().numpy()
    scenes = []
    for room, name in enumerate(names):
        objects = []
        for item in kept[room].nonzero()[:, 0].tolist():
            label = classes[int(labels[room, item])]
            if label == "void":
                continue
            mesh = None
            if decoded.vertices_m is not None:
                mesh = Mesh(decoded.vertices_m[room, item].cpu().numpy(), corners)
            center = tuple(decoded.centers_m[room, item].tolist())
            size = tuple(decoded.sizes_m[room, item].tolist())
            objects.append(SceneObject(label, center, size, mesh))
        scenes.append(Scene(name, label_set_name, tuple(objects)))
    return scenes


@torch.no_grad()
def decode_latents(
    trained: TrainedPrior, z: Float[Tensor, "rooms width"], names: list[str]
) -> list[Scene]:
    """Scenes of latents; meshes once the shape stage has finished."""
    scenes: list[Scene] = []
    for start in range(0, len(z), BATCH):
        part = slice(start, start + BATCH)
        decoded = trained.prior.decode(z[part], with_shape=trained.stage != "layout")
        scenes += to_scenes(
            decoded,
            trained.prior.shape.faces,
            trained.config.label_set,
            names[part],
            trained.config.loss.completeness_target,
        )
    return scenes


def decode_training_rooms(trained: TrainedPrior) -> list[Scene]:
    """The training rooms as the prior remembers them, named by their ids.

    Raises:
        InputError: training rooms have no latents in runs of this kind.
    """
    if not trained.remembers_rooms:
        raise InputError(
            f"A run of `stages: {trained.config.stages}` keeps no latents of training rooms, so "
            "none can be decoded; take a run of `stages: two`."
        )
    z = trained.prior.sphere(trained.logits)
    return decode_latents(trained, z, list(trained.room_ids))


def synthesize(trained: TrainedPrior, count: int, seed: int, law: str | None = None) -> list[Scene]:
    """New scenes: latents sampled by a law (None: `trained.law`), decoded."""
    z = sample_latents(trained.prior.sphere, trained.logits, count, seed, law or trained.law)
    names = [f"seed{seed}_{index:04d}" for index in range(count)]
    return decode_latents(trained, z, names)

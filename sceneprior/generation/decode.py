"""Decoded batches or boxes in, single `Scene`s out; latents of training rooms and new ones."""

import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.classes import VOID, label_set
from sceneprior.errors import InputError
from sceneprior.generation.sample import sample_latents
from sceneprior.losses.completeness import kept_objects
from sceneprior.scene import Mesh, Scene, SceneObject
from sceneprior.training.method import TrainedPrior, TrainedSampler
from sceneprior.views import DecodedScenes, RoomBoxes

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
    slots = furnished_slots(decoded, completeness_target)
    labels = decoded.class_logits.argmax(dim=-1)
    corners = faces.cpu().numpy()
    scenes = []
    for room, name in enumerate(names):
        objects = []
        for item in slots[room]:
            label = classes[int(labels[room, item])]
            mesh = None
            if decoded.vertices_m is not None:
                mesh = Mesh(decoded.vertices_m[room, item].cpu().numpy(), corners)
            center = tuple(decoded.centers_m[room, item].tolist())
            size = tuple(decoded.sizes_m[room, item].tolist())
            objects.append(SceneObject(label, center, size, mesh))
        scenes.append(Scene(name, label_set_name, tuple(objects)))
    return scenes


def furnished_slots(
    decoded: DecodedScenes, completeness_target: str = "first_n"
) -> list[list[int]]:
    """Which of the N predictions of each room `to_scenes` makes objects of, in its order."""
    kept = kept_objects(decoded.completeness_logits, completeness_target)
    kept = kept & (decoded.class_logits.argmax(dim=-1) != VOID)
    return [row.nonzero()[:, 0].tolist() for row in kept]


def boxes_to_scenes(rooms: RoomBoxes, label_set_name: str, names: list[str]) -> list[Scene]:
    """Objects that have no mesh; they are drawn as boxes. Yaws, where known, are in `extra`."""
    classes = label_set(label_set_name)
    scenes = []
    for room, name in enumerate(names):
        there = rooms.is_object[room]
        objects = tuple(
            SceneObject(classes[label], tuple(box[:3]), tuple(box[3:]))
            for label, box in zip(
                rooms.object_class[room, there].tolist(),
                rooms.boxes_m[room, there].tolist(),
                strict=True,
            )
        )
        yaws = None if rooms.yaw_rad is None else rooms.yaw_rad[room, there].tolist()
        extra = {} if yaws is None else {"yaw_rad": yaws}
        scenes.append(Scene(name, label_set_name, objects, extra=extra))
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
            trained.config.model.completeness_target,
        )
    return scenes


def decode_training_rooms(trained: TrainedPrior | TrainedSampler) -> list[Scene]:
    """The training rooms as the prior remembers them, named by their ids.

    Raises:
        InputError: training rooms have no latents in runs of this kind.
    """
    if isinstance(trained, TrainedSampler) or not trained.remembers_rooms:
        raise InputError(
            f"A run of `method: {trained.config.method}` keeps no latents of training rooms, so "
            "none can be decoded; take a run of `method: ours`."
        )
    z = trained.prior.latent_space(trained.logits)
    return decode_latents(trained, z, list(trained.room_ids))


def draw_latents(
    trained: TrainedPrior, count: int, seed: int, distribution: str | None = None
) -> tuple[Float[Tensor, "count width"], list[str]]:
    """Latents sampled by a distribution (None: the run's own), and the names of their rooms."""
    z = sample_latents(
        trained.prior.latent_space,
        trained.logits,
        count,
        seed,
        distribution or trained.distribution,
    )
    return z, scene_names(count, seed)


def synthesize(
    trained: TrainedPrior | TrainedSampler, count: int, seed: int, distribution: str | None = None
) -> list[Scene]:
    """New scenes, of a run of any kind.

    Args:
        trained: From `sceneprior.config.load_any_run`.
        count: How many.
        seed: Same seed, same rooms.
        distribution: Where latents come from; None takes the run's own.

    Raises:
        InputError: a distribution for a method without latents, or one that does not exist.
    """
    if isinstance(trained, TrainedSampler):
        if distribution is not None:
            raise InputError(
                f"A distribution says where latents of rooms come from, but `method: "
                f"{trained.config.method}` has none; leave out --distribution {distribution}."
            )
        rooms = trained.prior.sample(count, seed)
        return boxes_to_scenes(rooms, trained.config.label_set, scene_names(count, seed))
    return decode_latents(trained, *draw_latents(trained, count, seed, distribution))


def scene_names(count: int, seed: int) -> list[str]:
    """What new rooms are called."""
    return [f"seed{seed}_{index:04d}" for index in range(count)]

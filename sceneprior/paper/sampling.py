"""Latents of rooms, sampled, named by the user or read from files, and the scenes that they decode
to."""

import io
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneprior.core.classes import VOID, label_set
from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.files import read_arrays, write_whole
from sceneprior.core.repeatable import check_seed, single_threaded
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.views import DecodedScenes
from sceneprior.paper.losses import kept_objects
from sceneprior.paper.prior import TrainedPrior
from sceneprior.training.method import Trained

BANDWIDTH = 0.15
"""Bandwidth of the kernel distribution, in standard deviations of the training rooms' logits: 0
copies training rooms, 1 is one Gaussian fitted to all. A larger bandwidth gives more novel rooms,
but also more rooms without a bed, or with two."""
DISTRIBUTIONS = ("kernel", "paper")
"""Distributions that latents of new rooms can be sampled from; see `sample_logits`."""
COPIES = (
    "The distribution `kernel` draws close to single training rooms: nine in ten of its rooms are "
    "near copies of one. The distribution `paper` takes nothing from single training rooms."
)
"""Warning given with the `kernel` distribution."""
LATENTS_FILE = "latents.npz"
Point = str | Scene | Float[Tensor, " dimension"] | Float[np.ndarray, " dimension"]
"""Anything that determines a point of a latent space; see `latent_of`."""
SHIPPED_WITH_LATENTS = "`demo-bedroom`, which comes with the package and has them"
"""The shipped prior that keeps the latents of its training rooms, for messages."""
BATCH = 64
"""Rooms decoded at a time."""


def marked(distribution: str) -> str:
    """A distribution's name as tables show it; that of `kernel` with a note."""
    note = ", copies: near training rooms" if distribution == "kernel" else ""
    return f"{distribution}{note}"


def draw_latents(
    trained: TrainedPrior, count: int, seed: int, distribution: str | None = None
) -> Float[Tensor, "count dimension"]:
    """Sample `count` latents; the same seed gives the same latents.

    `sample_logits` describes the distributions; None is the run's own. The distribution `kernel`
    gives a warning that its rooms are near copies (`COPIES`).
    """
    distribution = distribution or trained.latent_distribution
    if distribution not in DISTRIBUTIONS:
        raise InputError(
            f"No sampling distribution '{distribution}'; choose from {', '.join(DISTRIBUTIONS)}."
        )
    if distribution != "paper" and len(trained.logits) < 2:
        raise InputError(
            f"The {distribution} distribution needs the latents of at least 2 training rooms, and "
            f"this prior keeps {len(trained.logits)} (a packed one keeps them if packed with "
            "--latents); use --distribution paper, leave it out, or take "
            f"{SHIPPED_WITH_LATENTS}."
        )
    space = trained.prior.latent_space
    z = space(sample_logits(trained.logits, count, seed, distribution, space.shift_free))
    if distribution == "kernel":
        warnings.warn(COPIES, InputWarning, stacklevel=1)
    return z


def example_rooms(trained: TrainedPrior, count: int) -> dict[str, list[Scene]]:
    """Rooms for pictures: `decoded` from latents of training rooms, if they have some, and `drawn`
    from N(0, 1)."""
    logits = trained.logits[:: max(-(-len(trained.logits) // count), 1)]
    points = {"decoded": trained.prior.latent_space(logits)} if len(logits) else {}
    points["drawn"] = draw_latents(trained, count, 0, "paper")
    return {
        name: decode_latents(trained, z, [f"{name}_{row}" for row in range(len(z))])
        for name, z in points.items()
    }


def sample_logits(
    trained: Float[Tensor, "rooms anchors"],
    count: int,
    seed: int,
    distribution: str,
    shift_free: bool,
) -> Float[Tensor, "count anchors"]:
    """Sample logits of latent weights for `draw_latents`.

    Args:
        distribution: `paper`: N(0, 1), from which the training rooms' logits were initialised;
            training has moved them since. `kernel`: a mixture of Gaussians around the training
            rooms' logits, with their mean and covariance (a smoothed bootstrap of width
            `BANDWIDTH`).
        shift_free: True if adding a constant to all logits of a room changes nothing, as in a
            softmax; this degree of freedom is then removed before the covariance is estimated.
    """
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(count, trained.shape[1], generator=generator, dtype=torch.float64)
    if distribution == "paper":
        return noise.to(trained.dtype)
    logits = trained.double()
    if shift_free:
        logits = logits - logits.mean(dim=1, keepdim=True)
    mean = logits.mean(dim=0)
    centred = logits - mean
    # centred^T centred is the covariance; the SVD gives its square root even where it is singular.
    _, scale, axes = torch.linalg.svd(centred / (len(logits) - 1) ** 0.5, full_matrices=False)
    drawn = (noise[:, : len(scale)] * scale) @ axes
    # A room is repeated only after all rooms have been used.
    rooms = len(logits)
    rounds = [torch.randperm(rooms, generator=generator) for _ in range(-(-count // rooms))]
    start = centred[torch.cat(rounds)[:count]]
    # Shrinking towards the mean offsets the variance of the noise, so the covariance is preserved.
    drawn = (1 - BANDWIDTH**2) ** 0.5 * start + BANDWIDTH * drawn
    return (mean + drawn).to(trained.dtype)


def write_latents(folder: Path, scenes: Sequence[Scene]) -> None:
    """Write `latents.npz`, with `latents`, one row per room, and `names`, the names of the rooms.

    Nothing is written if any room has no latent.
    """
    latents = [scene.latent for scene in scenes if scene.latent is not None]
    if not latents or len(latents) < len(scenes):
        return
    buffer = io.BytesIO()
    np.savez(buffer, latents=np.stack(latents), names=np.array([scene.name for scene in scenes]))
    write_whole(Path(folder) / LATENTS_FILE, buffer.getvalue())


def with_training_latents(trained: Trained, purpose: str) -> TrainedPrior:
    """Return `trained` if it keeps the latents of its training rooms.

    Raises:
        InputError: it does not; the message names the `purpose`, and priors that keep them.
    """
    if isinstance(trained, TrainedPrior) and trained.remembers_rooms:
        return trained
    if trained.config.remembers_rooms:
        raise InputError(
            f"{purpose} needs the latents of training rooms, and this prior was packed without "
            "them; take the run that it was packed from, a prior packed with `sceneprior pack "
            f"--latents`, or {SHIPPED_WITH_LATENTS}."
        )
    raise InputError(
        f"{purpose} needs the latents of training rooms, and a run of `method: "
        f"{trained.config.method}` keeps none; take a run of `method: paper` or `method: lifted`."
    )


def latent_of(trained: TrainedPrior, point: Point) -> Float[Tensor, " dimension"]:
    """The latent for a room's name (`read_latent`), for a scene (the latent from which it was
    decoded), or for a vector (the nearest point of the latent space).
    """
    if isinstance(point, str):
        return read_latent(trained, point)
    if isinstance(point, Scene):
        if point.latent is None:
            raise InputError(
                f"Room {point.name} has no latent (a sampler generated it, or it was read from a "
                "file); take a room of another distribution (`kernel`, `paper`), or name one, such "
                "as 'seed:7'."
            )
        return _onto(trained, point.latent, f"Room {point.name}")
    return _onto(trained, np.asarray(point), "The vector")


def _onto(trained: TrainedPrior, point: np.ndarray, source: str) -> Float[Tensor, " dimension"]:
    """The nearest point of the latent space; `source` names the latent's origin in errors."""
    width = trained.config.model.width
    if point.shape != (width,):
        raise InputError(
            f"{source} has a latent of shape {point.shape}, but this prior's have {width} numbers; "
            "take latents of the same run."
        )
    if not np.isfinite(point).all() or not point.any():
        raise InputError(f"{source}: a latent is all zeros or holds no numbers; write it again.")
    space = trained.prior.latent_space
    return space.onto(torch.from_numpy(point).to(trained.logits.dtype).unsqueeze(0))[0]


def read_latent(trained: TrainedPrior, text: str) -> Float[Tensor, " dimension"]:
    """Read a latent of a run from text, which is one of:

    - the id of a training room;
    - `seed:7`, for the room that `synthesize -n 1 --seed 7` makes from latents; `paper:7` and
      `kernel:7` also name the distribution;
    - a file of latents, as `write_latents` writes it: `FILE` (its first latent), `FILE:3` (counted
      from 0) or `FILE:NAME`.
    """
    file, _, item = text.rpartition(":")
    path, item = (Path(file), item) if file.endswith(".npz") else (Path(text), "0")
    if text in trained.room_ids or not path.is_file():
        return named_latent(trained, text, "a file of latents (.npz)")
    hint = "expected (n, D) numbers, as in the latents.npz that `sceneprior synthesize` writes"
    data = read_arrays(path, hint, ("latents", "names"))
    latents = data.get("latents", np.zeros(0))
    names = [*map(str, np.ravel(data.get("names", [])))]
    if latents.ndim != 2 or not latents.size or latents.dtype.kind not in "iuf":
        came = f"{latents.dtype} of shape {latents.shape}" if "latents" in data else "none"
        raise InputError(f"{path} holds no latents ({came}); {hint}.")
    latents = latents.astype(np.float64)
    if item in names:
        row = names.index(item)
    elif item.isdecimal() and int(item) < len(latents):
        row = int(item)
    else:
        known = f"names such as {names[0]}" if names else "no names"
        raise InputError(f"{path} has no latent '{item}': it holds {len(latents)} and {known}.")
    return _onto(trained, latents[row], f"{path}, row {row}")


def named_latent(trained: TrainedPrior, name: str, or_else: str) -> Float[Tensor, " dimension"]:
    """The latent of a training room, given by its id, or of a new room: `seed:7` from the run's
    distribution of latents, `paper:7` or `kernel:7` from the named distribution.

    The error for any other name lists what is valid; `or_else` is the last item of that list.
    """
    if name in trained.room_ids:
        row = trained.room_ids.index(name)
        return trained.prior.latent_space(trained.logits[row : row + 1])[0]
    if (found := re.fullmatch(rf"(seed|{'|'.join(DISTRIBUTIONS)}):(\d+)", name)) is not None:
        distribution, seed = None if found[1] == "seed" else found[1], int(found[2])
        check_seed(seed)
        return draw_latents(trained, 1, seed, distribution)[0]
    others = f"seed:NUMBER ({', '.join(f'{each}:NUMBER' for each in DISTRIBUTIONS)}), nor {or_else}"
    if not trained.room_ids and trained.config.remembers_rooms:
        raise InputError(
            f"'{name}' is neither {others}; training rooms cannot be named, because this prior was "
            f"packed without their latents: for them, take {SHIPPED_WITH_LATENTS}."
        )
    known = f"such as {trained.room_ids[0]}" if trained.room_ids else "which keeps none"
    raise InputError(f"'{name}' is neither a training room of this run ({known}), nor {others}.")


class DecodedRoom(NamedTuple):
    """A decoded scene, with the predictions that its objects come from and their class logits."""

    scene: Scene
    predictions: list[int]
    """Index of each object's prediction among the network's N."""
    class_logits: Float[Tensor, "objects classes"]


def kept_predictions(
    trained: TrainedPrior, decoded: DecodedScenes
) -> Bool[Tensor, "rooms objects"]:
    """True for predictions that are objects: the completeness scores keep them, and their most
    likely class is not `void`."""
    kept = kept_objects(decoded.completeness_logits, trained.config.model.completeness_target)
    return kept & (decoded.class_logits.argmax(dim=-1) != VOID)


def to_rooms(
    trained: TrainedPrior, decoded: DecodedScenes, names: Sequence[str]
) -> list[DecodedRoom]:
    """Scenes of the `kept_predictions` of decoded rooms, with their most likely classes."""
    kept = kept_predictions(trained, decoded)
    rooms = []
    for row, name in enumerate(names):
        predictions = kept[row].nonzero()[:, 0].tolist()
        scene = scene_of(trained, decoded, row, predictions, name)
        rooms.append(DecodedRoom(scene, predictions, decoded.class_logits[row, predictions]))
    return rooms


def scene_of(
    trained: TrainedPrior, decoded: DecodedScenes, row: int, predictions: Sequence[int], name: str
) -> Scene:
    """A scene of the given predictions of one room, in the given order.

    An object has its most likely class other than void, and a mesh if shapes were decoded.
    """
    shape, classes = trained.prior.shape, label_set(trained.config.label_set)
    objects = []
    for item in predictions:
        logits = decoded.class_logits[row, item].clone()
        logits[VOID] = -torch.inf
        center, size = (part[row, item].tolist() for part in (decoded.centers_m, decoded.sizes_m))
        mesh, solids = shape.mesh_of(decoded, row, item), shape.solids_of(decoded, row, item)
        label = classes[int(logits.argmax())]
        objects.append(SceneObject(label, tuple(center), tuple(size), mesh, solids=solids))
    return Scene(name, trained.config.label_set, tuple(objects))


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
    rooms: list[DecodedRoom] = []
    for start in range(0, len(z), BATCH):
        part = slice(start, start + BATCH)
        decoded = trained.prior.decode(z[part], with_shape=trained.stage != "layout")
        rooms += to_rooms(trained, reshaped(decoded, part), names[part])
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

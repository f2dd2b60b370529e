"""Latents of rooms: sampled around the training rooms, read by name, and written to files."""

import io
import json
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.files import write_whole
from sceneprior.core.repeatable import check_seed
from sceneprior.core.scene import Scene
from sceneprior.paper.latents import LatentSpace
from sceneprior.paper.prior import SHIPPED_WITH_LATENTS, TrainedPrior

BANDWIDTH = 0.15
"""Bandwidth of the kernel distribution, in standard deviations of the training rooms' logits: 0
copies training rooms, 1 is one Gaussian fitted to all. A larger bandwidth gives more novel rooms,
but also more rooms without a bed, or with two."""
DISTRIBUTIONS = ("kernel", "paper")
"""Distributions that latents of new rooms can be sampled from; see `sample_logits`."""
MARKS = {"kernel": "copies: near training rooms"}
"""Notes that tables add to the name of a distribution whose rooms are near training rooms."""
COPIES = (
    "The distribution `kernel` draws close to single training rooms: nine in ten of its rooms are "
    "near copies of one. The distribution `paper` takes nothing from single training rooms."
)
"""Warning given with the `kernel` distribution."""
LATENTS_FILE = "latents.npz"
Point = str | Scene | Float[Tensor, " dimension"] | Float[np.ndarray, " dimension"]
"""Anything that determines a point of a latent space; see `latent_of`."""
_ENDINGS = (".npz", ".npy", ".json")


def marked(distribution: str) -> str:
    """A distribution's name as tables show it, followed by its note in `MARKS`, if it has one."""
    mark = MARKS.get(distribution)
    return distribution if mark is None else f"{distribution}, {mark}"


def sample_latents(
    space: LatentSpace,
    trained: Float[Tensor, "rooms anchors"],
    count: int,
    seed: int,
    distribution: str = "paper",
) -> Float[Tensor, "count dimension"]:
    """Sample `count` points of the latent space; the same seed gives the same points.

    `trained` holds the logits of the training rooms; `sample_logits` describes the distributions.
    """
    if distribution not in DISTRIBUTIONS:
        raise InputError(
            f"No sampling distribution '{distribution}'; choose from {', '.join(DISTRIBUTIONS)}."
        )
    if distribution != "paper" and len(trained) < 2:
        raise InputError(
            f"The {distribution} distribution needs the latents of at least 2 training rooms, and "
            f"this prior keeps {len(trained)} (a packed one keeps them if packed with --latents); "
            f"use --distribution paper, leave it out, or take {SHIPPED_WITH_LATENTS}."
        )
    return space(sample_logits(trained, count, seed, distribution, space.shift_free))


def sample_logits(
    trained: Float[Tensor, "rooms anchors"],
    count: int,
    seed: int,
    distribution: str,
    shift_free: bool = True,
) -> Float[Tensor, "count anchors"]:
    """Sample logits of latent weights for `sample_latents`.

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


def draw_latents(
    trained: TrainedPrior, count: int, seed: int, distribution: str | None = None
) -> tuple[Float[Tensor, "count dimension"], list[str]]:
    """Sample latents from a distribution (None: the run's own); also return the rooms' names.

    The distribution `kernel` gives a warning that its rooms are near copies (`COPIES`).
    """
    space = trained.prior.latent_space
    distribution = distribution or trained.latent_distribution
    z = sample_latents(space, trained.logits, count, seed, distribution)
    if distribution == "kernel":
        warnings.warn(COPIES, InputWarning, stacklevel=1)
    return z, scene_names(count, seed)


def scene_names(count: int, seed: int) -> list[str]:
    """Names of generated rooms."""
    return [f"seed{seed}_{index:04d}" for index in range(count)]


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
    - a file of latents: `FILE` (its first latent), `FILE:3` (counted from 0) or `FILE:NAME`. The
      file is a `latents.npz`, an .npy of (D,) or (n, D) numbers, or a .json of such lists.
    """
    file, _, item = text.rpartition(":")
    path, item = (Path(file), item) if file.endswith(_ENDINGS) else (Path(text), "0")
    if text in trained.room_ids or not path.is_file():
        return named_latent(trained, text, f"a file of latents ({', '.join(_ENDINGS)})")
    latents, names = _read_latents(path)
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
        return draw_latents(trained, 1, seed, distribution)[0][0]
    others = f"seed:NUMBER ({', '.join(f'{each}:NUMBER' for each in DISTRIBUTIONS)}), nor {or_else}"
    if not trained.room_ids and trained.config.remembers_rooms:
        raise InputError(
            f"'{name}' is neither {others}; training rooms cannot be named, because this prior was "
            f"packed without their latents: for them, take {SHIPPED_WITH_LATENTS}."
        )
    known = f"such as {trained.room_ids[0]}" if trained.room_ids else "which keeps none"
    raise InputError(f"'{name}' is neither a training room of this run ({known}), nor {others}.")


def _read_latents(path: Path) -> tuple[np.ndarray, list[str]]:
    try:
        raw = path.read_bytes()
        data: Any = json.loads(raw) if path.suffix == ".json" else np.load(io.BytesIO(raw))
        names: list[str] = []
        if isinstance(data, Mapping):
            if "latents" not in data:
                raise ValueError("it has no 'latents'")
            data, names = data["latents"], [str(name) for name in data.get("names", [])]
        latents = np.atleast_2d(np.asarray(data, dtype=np.float64))
        if latents.ndim != 2 or not latents.size:
            raise ValueError(f"an array of shape {latents.shape}")
    except Exception as error:  # NumPy's error depends on which byte is damaged
        raise InputError(
            f"{path} holds no latents ({type(error).__name__}: {error}); expected (n, D) numbers, "
            "as in the latents.npz that `sceneprior synthesize` writes."
        ) from None
    return latents, names

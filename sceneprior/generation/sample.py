"""Latents of rooms: drawn around the training rooms, read as the user names them, and written."""

import io
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.errors import InputError
from sceneprior.files import write_whole
from sceneprior.models.latents import LatentSpace
from sceneprior.scene import Scene
from sceneprior.training.method import TrainedPrior

NEIGHBOURS = 20
"""Rooms that a geodesic may lead to; more reach further from the training rooms."""
BANDWIDTH = 0.15
"""Of the kernel distribution, in standard deviations of the training rooms' logits: 0 copies
training rooms, 1 is the gaussian distribution. Larger is newer, and more often a room without a
bed or with two."""
DISTRIBUTIONS = ("kernel", "geodesic", "gaussian", "paper")
"""Of latents; new rooms may come from `SAMPLER`, too, which knows none."""
SAMPLER = "sampler"
MARKS = {
    "kernel": "near training rooms",
    "geodesic": "near training rooms",
    "gaussian": "fitted to training rooms",
}
"""What tables say of rooms of a distribution that knows training rooms: nothing of `paper`, which
takes nothing from them."""
LATENTS_FILE = "latents.npz"
Point = str | Scene | Float[Tensor, " dimension"] | Float[np.ndarray, " dimension"]
"""What says a point of a latent space; see `latent_of`."""
_ENDINGS = (".npz", ".npy", ".json")


def sample_latents(
    space: LatentSpace,
    trained: Float[Tensor, "rooms anchors"],
    count: int,
    seed: int,
    distribution: str = "kernel",
) -> Float[Tensor, "count dimension"]:
    """Draw points of the latent space around training rooms, whose logits are `trained`; the same
    seed, the same points.

    `geodesic` takes a point anywhere on the geodesic (in a cube: the straight line) between a
    training room drawn at random and one of its `NEIGHBOURS` nearest. The other distributions: see
    `sample_logits`.

    Raises:
        InputError: an unknown distribution, or fewer than two training rooms to draw between.
    """
    if distribution not in DISTRIBUTIONS:
        raise InputError(
            f"No sampling distribution '{distribution}'; choose from {', '.join(DISTRIBUTIONS)}."
        )
    if distribution != "paper" and len(trained) < 2:
        raise InputError(
            f"The {distribution} distribution needs at least 2 training rooms; use --distribution "
            "paper."
        )
    if distribution != "geodesic":
        return space(sample_logits(trained, count, seed, distribution, space.shift_free))
    generator = torch.Generator().manual_seed(seed)
    start = _rooms_in_turn(len(trained), count, generator)
    z = space(trained)
    closeness = space.nearness(z[start], z)
    closeness[torch.arange(count), start] = -torch.inf  # no room is its own neighbour
    nearest = closeness.topk(min(NEIGHBOURS, len(trained) - 1), dim=1).indices
    pick = torch.randint(nearest.shape[1], (count, 1), generator=generator)
    end = nearest.gather(1, pick)[:, 0]
    along = torch.rand(count, generator=generator).to(trained.dtype)
    return space.between(z[start], z[end], along)


def sample_logits(
    trained: Float[Tensor, "rooms anchors"],
    count: int,
    seed: int,
    distribution: str,
    shift_free: bool = True,
) -> Float[Tensor, "count anchors"]:
    """Draw logits of latent weights, as `sample_latents`.

    Args:
        distribution: `paper`: N(0, 1), which is where training rooms' logits started, not where
            they ended. `gaussian`: the mean and covariance of the training rooms' logits.
            `kernel`: the same mean and covariance, as a mixture of Gaussians around the training
            rooms (a smoothed bootstrap of width `BANDWIDTH`).
        shift_free: Whether a constant added to all logits of a room changes nothing, as where a
            softmax turns them into weights; that freedom is taken out first.
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
    # centred^T centred is the covariance; its square root needs no positive definiteness.
    _, scale, axes = torch.linalg.svd(centred / (len(logits) - 1) ** 0.5, full_matrices=False)
    drawn = (noise[:, : len(scale)] * scale) @ axes
    if distribution == "kernel":
        start = centred[_rooms_in_turn(len(logits), count, generator)]
        # Drawn in towards the mean by as much as the noise adds: the covariance stays.
        drawn = (1 - BANDWIDTH**2) ** 0.5 * start + BANDWIDTH * drawn
    return (mean + drawn).to(trained.dtype)


def _rooms_in_turn(rooms: int, count: int, generator: torch.Generator) -> Int[Tensor, " count"]:
    """Rooms in random order, none a second time before each was there once."""
    rounds = [torch.randperm(rooms, generator=generator) for _ in range(-(-count // rooms))]
    return torch.cat(rounds)[:count]


def uses_sampler(trained: TrainedPrior, distribution: str | None) -> bool:
    """Whether new rooms come from the run's sampler: asked for, or the run's own way (None).

    Raises:
        InputError: it is asked for, but the run has none, or not yet.
    """
    if (distribution or trained.distribution) != SAMPLER:
        return False
    if trained.sampler is None:
        raise InputError(
            "This run has no sampler, or its stage has not begun; leave out --distribution "
            f"{SAMPLER}, or train with a section `sampler` (`--config front_bedroom_large.yaml`)."
        )
    return True


def draw_latents(
    trained: TrainedPrior, count: int, seed: int, distribution: str | None = None
) -> tuple[Float[Tensor, "count dimension"], list[str]]:
    """Latents sampled by a distribution (None: the run's own), and the names of their rooms."""
    space = trained.prior.latent_space
    distribution = distribution or trained.latent_distribution
    z = sample_latents(space, trained.logits, count, seed, distribution)
    return z, scene_names(count, seed)


def scene_names(count: int, seed: int) -> list[str]:
    """What new rooms are called."""
    return [f"seed{seed}_{index:04d}" for index in range(count)]


def write_latents(folder: Path, scenes: Sequence[Scene]) -> None:
    """Write `latents.npz`: `latents`, one row a room, and `names`, those of the rooms' files;
    nothing where a room has no latent."""
    latents = [scene.latent for scene in scenes if scene.latent is not None]
    if not latents or len(latents) < len(scenes):
        return
    buffer = io.BytesIO()
    np.savez(buffer, latents=np.stack(latents), names=np.array([scene.name for scene in scenes]))
    write_whole(Path(folder) / LATENTS_FILE, buffer.getvalue())


def latent_of(trained: TrainedPrior, point: Point) -> Float[Tensor, " dimension"]:
    """The point of a run's latent space that a name says (`read_latent`), that a scene is decoded
    from, or that is nearest to a vector.

    Raises:
        InputError: nothing is called so, the scene has no latent, or the vector another size.
    """
    if isinstance(point, str):
        return read_latent(trained, point)
    if isinstance(point, Scene):
        if point.latent is None:
            raise InputError(
                f"Room {point.name} comes from no latent (a sampler drew it, or it was read from a "
                "file); take a room of another distribution (`kernel`, `paper`), or name one, such "
                "as 'seed:7'."
            )
        return _onto(trained, point.latent, f"Room {point.name}")
    return _onto(trained, np.asarray(point), "The vector")


def _onto(trained: TrainedPrior, point: np.ndarray, source: str) -> Float[Tensor, " dimension"]:
    """The nearest point of the latent space; `source` says whose latent it is."""
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
    """The point of a run's latent space that a text names.

    A name is the id of a training room; `seed:7`, the room that `synthesize -n 1 --seed 7` makes;
    or a file of latents: `FILE` (its first), `FILE:3` (counted from 0), `FILE:NAME`. Files are
    `latents.npz`, an .npy of (D,) or (n, D) numbers, or a .json of such lists.

    Raises:
        InputError: nothing is called so, or the file does not hold a latent of this run's size.
    """
    space = trained.prior.latent_space
    if text in trained.room_ids:
        row = trained.room_ids.index(text)
        return space(trained.logits[row : row + 1])[0]
    if re.fullmatch(r"seed:\d{1,18}", text):
        return draw_latents(trained, 1, int(text[5:]))[0][0]
    file, _, item = text.rpartition(":")
    path, item = (Path(file), item) if file.endswith(_ENDINGS) else (Path(text), "0")
    if not path.is_file():
        known = f"such as {trained.room_ids[0]}" if trained.room_ids else "which keeps none"
        raise InputError(
            f"'{text}' is neither a training room of this run ({known}), "
            f"nor seed:NUMBER, nor a file of latents ({', '.join(_ENDINGS)})."
        )
    latents, names = _read_latents(path)
    if item in names:
        row = names.index(item)
    elif item.isdecimal() and int(item) < len(latents):
        row = int(item)
    else:
        known = f"names such as {names[0]}" if names else "no names"
        raise InputError(f"{path} has no latent '{item}': it holds {len(latents)} and {known}.")
    return _onto(trained, latents[row], f"{path}, row {row},")


def _read_latents(path: Path) -> tuple[np.ndarray, list[str]]:
    try:
        raw = path.read_bytes()
        data: Any = json.loads(raw) if path.suffix == ".json" else np.load(io.BytesIO(raw))
        names: list[str] = []
        if isinstance(data, Mapping):
            data, names = data["latents"], [str(name) for name in data.get("names", [])]
        latents = np.atleast_2d(np.asarray(data, dtype=np.float64))
        if latents.ndim != 2 or not latents.size:
            raise ValueError(f"an array of shape {latents.shape}")
    except Exception as error:  # what numpy raises depends on which byte is damaged
        raise InputError(
            f"{path} holds no latents ({type(error).__name__}: {error}); expected (n, D) numbers, "
            "as in the latents.npz that `sceneprior synthesize` writes."
        ) from None
    return latents, names

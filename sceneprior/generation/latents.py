"""Points of a run's latent space, by what people call them: a room, a seed, a file."""

import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.errors import InputError
from sceneprior.files import write_whole
from sceneprior.generation.decode import draw_latents
from sceneprior.training.method import TrainedPrior

LATENTS_FILE = "latents.npz"
_ENDINGS = (".npz", ".npy", ".json")


def write_latents(folder: Path, z: Float[Tensor, "rooms dimension"], names: list[str]) -> None:
    """Write `latents.npz`: `latents`, one row a room, and `names`, those of the rooms' files."""
    buffer = io.BytesIO()
    np.savez(buffer, latents=z.numpy(), names=np.array(names))
    write_whole(Path(folder) / LATENTS_FILE, buffer.getvalue())


def read_latent(trained: TrainedPrior, text: str) -> Float[Tensor, " dimension"]:
    """The point of a run's latent space that a text names.

    Args:
        trained: The run's prior.
        text: The id of a training room; `seed:7`, the room that `synthesize -n 1 --seed 7` makes;
            or a file of latents: `FILE` (its first), `FILE:3` (counted from 0), `FILE:NAME`. Files
            are `latents.npz`, an .npy of (D,) or (n, D) numbers, or a .json of such lists.

    Raises:
        InputError: nothing is called so, or the file does not hold a latent of this run's size.
    """
    space = trained.prior.latent_space
    if text in trained.room_ids:
        row = trained.room_ids.index(text)
        return space(trained.logits[row : row + 1])[0]
    if re.fullmatch(r"seed:\d{1,18}", text):
        return draw_latents(trained, 1, int(text[5:]))[0][0]
    path, item = _split(text)
    if not path.is_file():
        known = f"such as {trained.room_ids[0]}" if trained.room_ids else "which keeps none"
        raise InputError(
            f"'{text}' is neither a training room of this run ({known}), "
            f"nor seed:NUMBER, nor a file of latents ({', '.join(_ENDINGS)})."
        )
    latents, names = _read(path)
    row = _row_of(path, item, len(latents), names)
    width = trained.config.model.width
    if latents.shape[1] != width:
        raise InputError(
            f"{path} holds latents of {latents.shape[1]} numbers, but this run's have {width}; "
            "take latents of the same run."
        )
    point = latents[row]
    if not np.isfinite(point).all() or not point.any():
        raise InputError(f"{path}: latent {row} is all zeros or holds no numbers; write it again.")
    return space.onto(torch.from_numpy(point).to(trained.logits.dtype).unsqueeze(0))[0]


def _split(text: str) -> tuple[Path, str]:
    path, colon, item = text.rpartition(":")
    if colon and path.endswith(_ENDINGS):
        return Path(path), item
    return Path(text), "0"


def _read(path: Path) -> tuple[np.ndarray, list[str]]:
    names: list[str] = []
    try:
        if path.suffix == ".json":
            data: Any = json.loads(path.read_text())
            if isinstance(data, dict):
                data, names = data["latents"], [str(name) for name in data.get("names", [])]
            latents = np.array(data, dtype=np.float64)
        elif path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                latents = file["latents"].astype(np.float64)
                names = file["names"].tolist() if "names" in file else []
        else:
            latents = np.load(path, allow_pickle=False).astype(np.float64)
        latents = np.atleast_2d(latents)
        if latents.ndim != 2 or not latents.size:
            raise ValueError(f"an array of shape {latents.shape}")
    except Exception as error:  # what numpy raises depends on which byte is damaged
        raise InputError(
            f"{path} holds no latents ({type(error).__name__}: {error}); expected (n, D) numbers, "
            "as in the latents.npz that `sceneprior synthesize` writes."
        ) from None
    return latents, names


def _row_of(path: Path, item: str, count: int, names: list[str]) -> int:
    if item in names:
        return names.index(item)
    if item.isdecimal() and int(item) < count:
        return int(item)
    known = f"names such as {names[0]}" if names else "no names"
    raise InputError(f"{path} has no latent '{item}': it holds {count} and {known}.")

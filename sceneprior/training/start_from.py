"""Start a training with the weights of another run."""

import re
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import nn

from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.training.method import read_checkpoint


def find_source(source: Path) -> Path:
    """The checkpoint, or the run's newest one; an `InputError` if there is none."""
    finals = [*source.glob("*/final.ckpt")] or [*source.glob("*/last.ckpt")]
    if not (source.is_file() or finals):
        raise InputError(f"init_from: {source} is neither a checkpoint nor a run with one.")
    return source if source.is_file() else max(finals, key=lambda each: each.stat().st_mtime)


def start_from(source: Path, module: nn.Module, labels: str, room_ids: Sequence[str]) -> None:
    """Copy the weights of a checkpoint, or of a run's newest one, to a module that was just built.

    Tensors of classes (`module.prior.by_class`) are copied row by row, by the classes' names, and
    latents by the rooms' ids; other rows keep their initial values. An `InputError` says if there
    is no checkpoint, or if it is of another network.
    """
    path = find_source(source)
    saved = read_checkpoint(path)
    said = saved.get("sceneprior", {})
    mine, theirs = label_set(labels), label_set(said.get("label_set", labels))
    by_class = getattr(module.prior, "by_class", None)
    if mine != theirs and by_class is None:
        raise InputError(f"init_from: {path} has other classes, which this method cannot map.")
    with torch.no_grad():
        for name, tensor in module.state_dict().items():
            found, rows = saved["state_dict"].get(name), None
            if name == "latents.weight":
                rows = _common(room_ids, said.get("room_ids", ()))
            elif by_class is not None and re.search(by_class, name):
                rows = _common(mine, theirs)  # and those after the last class, as they are
                rows += [(len(mine) + i, len(theirs) + i) for i in range(len(tensor) - len(mine))]
            fixed = slice(int(rows is not None), None)
            if found is None or found.shape[fixed] != tensor.shape[fixed]:
                raise InputError(f"init_from: {path} is of another network: {name} does not fit.")
            if rows is None:
                tensor.copy_(found)
            for own, other in rows or ():
                tensor[own] = found[other]


def _common(mine: Sequence[str], theirs: Sequence[str]) -> list[tuple[int, int]]:
    """Both indices of each name that two lists have in common."""
    at = {name: index for index, name in enumerate(theirs)}
    return [(index, at[name]) for index, name in enumerate(mine) if name in at]

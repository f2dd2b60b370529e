"""A run's folder: which checkpoint to take, and how one is written and read.

RUN/config.yaml            every setting, defaults included
RUN/<stage>/last.ckpt      newest checkpoint of the stage: what `--resume` continues from
RUN/<stage>/final.ckpt     the stage is done: what tasks take unless asked for `best`
RUN/<stage>/best.ckpt      where `samples.every` is set: what generated best (training/monitor.py)
RUN/<stage>/samples.json   the newest evaluation and the best so far; pictures in samples/
RUN/<stage>/metrics.csv    one line an epoch; TensorBoard's files lie beside it
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from sceneprior.errors import InputError
from sceneprior.files import write_whole

if TYPE_CHECKING:
    import lightning

CHECKPOINTS = ("final", "best")


def find_checkpoint(
    run: Path, stages: Sequence[str], checkpoint: str = "final"
) -> tuple[str, Path]:
    """The stage and path of the checkpoint that tasks use, of the `stages` in their order.

    `final` is the furthest finished stage's, else the furthest begun one's; `best` the one that
    generated best in the furthest stage that has one.

    Raises:
        InputError: what was asked for was not saved in the run yet.
    """
    if checkpoint not in CHECKPOINTS:
        raise InputError(f"No checkpoint '{checkpoint}'; choose from {', '.join(CHECKPOINTS)}.")
    names = ("best.ckpt",) if checkpoint == "best" else ("final.ckpt", "last.ckpt")
    for name in names:
        for stage in reversed(stages):
            if (run / stage / name).is_file():
                return stage, run / stage / name
    if checkpoint == "best":
        raise InputError(
            f"{run} holds no best.ckpt: its config has samples.every at 0, or nothing was "
            "evaluated yet. Use the final checkpoint, or train with `--set samples.every=25`."
        )
    raise InputError(
        f"{run} holds no checkpoint yet; let `sceneprior fit --config {run / 'config.yaml'} "
        f"--run {run} --resume` get further."
    )


def write_checkpoint(trainer: "lightning.Trainer", folder: Path, name: str) -> None:
    """Write a checkpoint whole or not at all; all processes call, the first writes."""
    if trainer.is_global_zero:
        write_whole(folder / name, trainer.save_checkpoint)
    else:
        trainer.save_checkpoint(folder / name)  # which takes part in saving, and writes nothing
    # Others may be about to read it.
    trainer.strategy.barrier()


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint's contents, tensors and plain data only; InputError if it is damaged."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise InputError(
            f"{path} cannot be read ({type(error).__name__}); it is damaged. Delete it and run "
            "`sceneprior fit` with `--resume`."
        ) from None


def read_networks(
    path: Path, build: Callable[[int], nn.ModuleDict]
) -> tuple[nn.ModuleDict, tuple[str, ...]]:
    """The networks of a checkpoint, and the ids of the rooms that it was trained on; `build` makes
    the networks, freshly initialised, for so many rooms.

    Raises:
        InputError: the checkpoint is damaged, of other networks, or not written by `fit`.
    """
    saved = read_checkpoint(path)
    try:
        room_ids = tuple(saved["sceneprior"]["room_ids"])
        networks = build(len(room_ids))
        # What helped in training alone, such as a discriminator, is not needed any more.
        weights = {k: v for k, v in saved["state_dict"].items() if k.split(".")[0] in networks}
        networks.load_state_dict(weights)
    except (KeyError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path} does not fit the run's config.yaml ({reason}); use the config it was trained "
            "with."
        ) from None
    return networks, room_ids

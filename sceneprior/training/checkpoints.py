"""A run's folder: which checkpoint to take, and how one is written and read.

RUN/config.yaml            every setting, defaults included
RUN/<stage>/last.ckpt      newest checkpoint of the stage: what `--resume` continues from
RUN/<stage>/final.ckpt     the stage is done: what tasks take unless asked for `best`
RUN/<stage>/best.ckpt      where `samples.every` is set: what generated best (training/monitor.py)
RUN/<stage>/samples.json   the newest evaluation and the best so far; pictures in samples/
RUN/<stage>/metrics.csv    one line an epoch; TensorBoard's files lie beside it
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning
import torch
from torch import nn

from sceneprior.errors import InputError
from sceneprior.files import write_whole
from sceneprior.models.prior import ScenePrior
from sceneprior.training.method import PriorConfig

CHECKPOINTS = ("final", "best")


def checkpoint_extra(label_set: str, room_ids: tuple[str, ...]) -> dict[str, Any]:
    """What a checkpoint says of its run beside the weights."""
    return {"sceneprior": {"room_ids": list(room_ids), "label_set": label_set}}


def find_checkpoint(
    run: Path, stages: Sequence[str], checkpoint: str = "final"
) -> tuple[str, Path]:
    """The stage and path of the checkpoint that tasks use.

    Args:
        run: A run's folder.
        stages: Names of its stages, in order.
        checkpoint: `final`: the furthest finished stage's, else the furthest begun one's. `best`:
            the one that generated best in the furthest stage that has one.

    Raises:
        InputError: what was asked for was not saved in it yet.
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


def write_checkpoint(trainer: lightning.Trainer, folder: Path, name: str) -> None:
    """Write a checkpoint whole or not at all; all processes call, the first writes."""
    if trainer.is_global_zero:
        write_whole(folder / name, trainer.save_checkpoint)
    else:
        trainer.save_checkpoint(folder / name)  # which takes part in saving, and writes nothing
    # Others may be about to read it.
    trainer.strategy.barrier()


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint's contents, tensors and plain data only.

    Raises:
        InputError: the file is damaged.
    """
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise InputError(
            f"{path} cannot be read ({type(error).__name__}); it is damaged. Delete it and run "
            "`sceneprior fit` with `--resume`."
        ) from None


def restore(networks: dict[str, nn.Module], saved: dict[str, Any], path: Path) -> None:
    """Load a checkpoint's weights into networks, by the names that its module has for them.

    Raises:
        InputError: the checkpoint is of other networks.
    """
    holder = nn.ModuleDict(networks)
    try:
        # What helped in training alone, such as a discriminator, is not needed any more.
        weights = {k: v for k, v in saved["state_dict"].items() if k.split(".")[0] in holder}
        holder.load_state_dict(weights)
    except (KeyError, RuntimeError) as error:
        raise _misfit(path, error) from None


def saved_room_ids(saved: dict[str, Any], path: Path) -> tuple[str, ...]:
    """Ids of the rooms that a checkpoint was trained on.

    Raises:
        InputError: it does not say, so `fit` did not write it.
    """
    try:
        return tuple(saved["sceneprior"]["room_ids"])
    except KeyError as error:
        raise _misfit(path, error) from None


def restore_prior(
    config: PriorConfig, path: Path, void: bool = True
) -> tuple[ScenePrior, nn.Embedding, tuple[str, ...]]:
    """Network, latents and room ids of a checkpoint of this config; `void` as in `build_prior`.

    Raises:
        InputError: the checkpoint is damaged, or of another network.
    """
    saved = read_checkpoint(path)
    room_ids = saved_room_ids(saved, path)
    prior, latents = config.build_prior(void), config.build_latents(len(room_ids))
    restore({"prior": prior, "latents": latents}, saved, path)
    return prior, latents, room_ids


def _misfit(path: Path, error: Exception) -> InputError:
    reason = " ".join(str(error).split())[:200]
    return InputError(
        f"{path} does not fit the run's config.yaml ({reason}); use the config it was trained with."
    )

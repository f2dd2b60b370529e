"""A run's folder: choosing, reading and writing its checkpoints.

RUN/config.yaml            all settings, defaults included
RUN/<stage>/last.ckpt      the stage's newest checkpoint, from which `--resume` continues
RUN/<stage>/final.ckpt     the finished stage, which commands load
RUN/<stage>/metrics.csv    one line per epoch; TensorBoard's files are in the same folder
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from sceneprior.core.errors import InputError
from sceneprior.core.files import write_whole

if TYPE_CHECKING:
    import lightning

_RESUMED = ("epoch", "global_step", "loops", "optimizer_states", "pytorch-lightning_version")
"""Keys of a checkpoint that the trainer needs to resume, in addition to the weights."""


def find_checkpoint(run: Path, stages: Sequence[str]) -> tuple[str, Path]:
    """Stage and path of the checkpoint that commands load; `stages` are the run's, in order.

    The last finished stage is chosen; if no stage is finished, the newest checkpoint of the last
    stage begun.
    """
    for name in ("final.ckpt", "last.ckpt"):
        for stage in reversed(stages):
            if (run / stage / name).is_file():
                return stage, run / stage / name
    raise InputError(
        f"{run} holds no checkpoint yet; continue its training with `sceneprior fit --config "
        f"{run / 'config.yaml'} --run {run} --resume`."
    )


def write_checkpoint(trainer: "lightning.Trainer", folder: Path, name: str) -> None:
    """Write a checkpoint atomically; every process calls this, and the first one writes."""
    if trainer.is_global_zero:
        write_whole(folder / name, trainer.save_checkpoint)
    else:
        trainer.save_checkpoint(folder / name)  # collective: takes part, but writes nothing
    # Other processes may be about to read it.
    trainer.strategy.barrier()


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The contents of a checkpoint: tensors and plain data only."""
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise InputError(
            f"{path} cannot be read ({type(error).__name__}); it is damaged. Delete it and run "
            "`sceneprior fit` with `--resume`."
        ) from None
    if not isinstance(saved, dict) or not isinstance(saved.get("state_dict"), dict):
        raise InputError(
            f"{path} is not a checkpoint of `sceneprior fit` (it has no state_dict). Delete it and "
            "run `sceneprior fit` with `--resume`."
        )
    return saved


def check_resumable(path: Path, module: nn.Module) -> None:
    """Check that a stage can be resumed from a checkpoint."""
    saved = read_checkpoint(path)
    missing = [name for name in _RESUMED if name not in saved]
    shapes = {name: getattr(value, "shape", None) for name, value in saved["state_dict"].items()}
    expected = {name: value.shape for name, value in module.state_dict().items()}
    if missing or shapes != expected:
        reason = f"it has no {missing[0]}" if missing else "its tensors are of another network"
        raise InputError(
            f"Training cannot be resumed from {path}: {reason}. Delete it, and the same command "
            "trains the stage from its start."
        )


def read_networks(
    path: Path, build: Callable[[int], nn.ModuleDict]
) -> tuple[nn.ModuleDict, tuple[str, ...]]:
    """The networks of a checkpoint, and the ids of the rooms that it was trained on.

    `build` takes the number of rooms and returns freshly initialised networks.
    """
    saved = read_checkpoint(path)
    try:
        room_ids = tuple(saved["sceneprior"]["room_ids"])
        networks = build(len(room_ids))
        # Weights used only in training, such as a discriminator's, are left out.
        weights = {k: v for k, v in saved["state_dict"].items() if k.split(".")[0] in networks}
        networks.load_state_dict(weights)
    except InputError:
        raise
    except Exception as error:  # the error depends on where the wrong part is first used
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path} does not fit the run's config.yaml ({reason}); use the config it was trained "
            "with."
        ) from None
    return networks, room_ids

"""A run's folder: what `fit` leaves in it, and the trained prior that tasks take out.

RUN/config.yaml            every setting, defaults included
RUN/<stage>/last.ckpt      newest checkpoint of the stage: what `--resume` continues from
RUN/<stage>/final.ckpt     the stage is done: what tasks take unless asked for `best`
RUN/<stage>/best.ckpt      where `samples.every` is set: what generated best (stages/samples.py)
RUN/<stage>/samples.json   the newest look's scores and the best so far; pictures in samples/
RUN/<stage>/metrics.csv    one line an epoch; TensorBoard's files lie beside it
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneprior.classes import label_set
from sceneprior.config import RunConfig, load_config
from sceneprior.errors import InputError
from sceneprior.models.scene_prior import ScenePrior
from sceneprior.stages.view_loss import build_latents, build_prior

STAGES = ("layout", "shape", "gan")
STAGES_OF = {"two": ("layout", "shape"), "one": ("shape",), "gan": ("gan",)}
"""What a run of `config.stages` trains, in order."""


@dataclass(frozen=True)
class TrainedPrior:
    """A prior with the latents of the rooms it was trained on, ready for use."""

    prior: ScenePrior
    logits: Float[Tensor, "rooms anchors"]
    room_ids: tuple[str, ...]
    config: RunConfig
    stage: str

    @property
    def remembers_rooms(self) -> bool:
        """Whether training rooms have latents of their own; a GAN's have none."""
        return len(self.logits) > 0

    @property
    def law(self) -> str:
        """Where new latents come from unless a task says otherwise: the config's law, but where
        there are no rooms to draw from, the law that the prior was trained under."""
        return self.config.sampling.law if self.remembers_rooms else "paper"


def checkpoint_extra(config: RunConfig, room_ids: tuple[str, ...]) -> dict[str, Any]:
    """What a checkpoint says of its run beside the weights."""
    return {"sceneprior": {"room_ids": list(room_ids), "label_set": config.label_set}}


CHECKPOINTS = ("final", "best")


def find_checkpoint(run: Path, checkpoint: str = "final") -> tuple[str, Path]:
    """The checkpoint that tasks use.

    Args:
        run: A run's folder.
        checkpoint: `final`: the furthest finished stage's, else the furthest begun one's. `best`:
            the one that generated best in the furthest stage that has one.

    Raises:
        InputError: the folder is no run, or what was asked for was not saved in it yet.
    """
    if checkpoint not in CHECKPOINTS:
        raise InputError(f"No checkpoint '{checkpoint}'; choose from {', '.join(CHECKPOINTS)}.")
    if not (run / "config.yaml").is_file():
        raise InputError(
            f"{run} is not a run folder (no config.yaml in it); train one with "
            "`sceneprior fit --config demo.yaml --run RUN`."
        )
    names = ("best.ckpt",) if checkpoint == "best" else ("final.ckpt", "last.ckpt")
    for name in names:
        for stage in reversed(STAGES):
            if (run / stage / name).is_file():
                return stage, run / stage / name
    if checkpoint == "best":
        raise InputError(
            f"{run} holds no best.ckpt: its config has samples.every at 0, or no look was taken "
            "yet. Use the final checkpoint, or train with `--set samples.every=25`."
        )
    raise InputError(
        f"{run} holds no checkpoint yet; let `sceneprior fit --config {run / 'config.yaml'} "
        f"--run {run} --resume` get further."
    )


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


def restore(config: RunConfig, path: Path) -> tuple[ScenePrior, nn.Embedding, tuple[str, ...]]:
    """Network, latents and room ids of a checkpoint of this config.

    Raises:
        InputError: the checkpoint is of another network.
    """
    saved = read_checkpoint(path)
    try:
        room_ids = tuple(saved["sceneprior"]["room_ids"])
        prior = build_prior(config, len(label_set(config.label_set)))
        latents = build_latents(config, len(room_ids))
        holder = nn.ModuleDict({"prior": prior, "latents": latents})
        # What helped in training alone, such as a discriminator, has done its work.
        weights = {k: v for k, v in saved["state_dict"].items() if k.split(".")[0] in holder}
        holder.load_state_dict(weights)
    except (KeyError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path} does not fit the run's config.yaml ({reason}); use the config it was "
            "trained with."
        ) from None
    return prior, latents, room_ids


def load_run(run: Path, checkpoint: str = "final") -> TrainedPrior:
    """The trained prior of a run, in evaluation mode; `checkpoint` as in `find_checkpoint`.

    Raises:
        InputError: the folder is no run, or its checkpoint is missing or damaged.
    """
    run = Path(run)
    stage, path = find_checkpoint(run, checkpoint)
    config = load_config(str(run / "config.yaml"))
    prior, latents, room_ids = restore(config, path)
    return TrainedPrior(
        prior.eval().requires_grad_(False), latents.weight.detach(), room_ids, config, stage
    )

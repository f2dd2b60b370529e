"""A run's folder: what `fit` leaves in it, and the trained prior that tasks take out.

`load_run` opens a run of our own kind, which has a latent space; `load_any_run` opens every kind.

RUN/config.yaml            every setting, defaults included
RUN/<stage>/last.ckpt      newest checkpoint of the stage: what `--resume` continues from
RUN/<stage>/final.ckpt     the stage is done: what tasks take unless asked for `best`
RUN/<stage>/best.ckpt      where `samples.every` is set: what generated best (training/monitor.py)
RUN/<stage>/samples.json   the newest look's scores and the best so far; pictures in samples/
RUN/<stage>/metrics.csv    one line an epoch; TensorBoard's files lie beside it
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneprior.baselines.atiss import stage as atiss3d
from sceneprior.baselines.atiss.network import Atiss
from sceneprior.baselines.sync2gen import stage as sync2gen
from sceneprior.baselines.sync2gen.network import Sync2Gen
from sceneprior.classes import label_set
from sceneprior.config import RunConfig, load_config
from sceneprior.errors import InputError
from sceneprior.models.prior import ScenePrior
from sceneprior.training.objective import build_latents, build_prior

STAGES_OF = {
    "two": ("layout", "shape"),
    "one": ("shape",),
    "gan": ("gan",),
    "atiss3d": ("atiss3d",),
    "sync2gen": ("sync2gen",),
}
"""What a run of `config.stages` trains, in order."""
STAGES = tuple(dict.fromkeys(stage for stages in STAGES_OF.values() for stage in stages))
"""Every stage there is; of two that a run has both, the later one last."""
SAMPLERS: dict[str, Callable[[RunConfig], Atiss | Sync2Gen]] = {
    "atiss3d": atiss3d.build_network,
    "sync2gen": sync2gen.build_network,
}
"""The network of each stage whose runs are a `TrainedSampler`."""


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
    def distribution(self) -> str:
        """Where new latents come from unless a task says otherwise: the config's distribution, but where
        there are no rooms to draw from, the distribution that the prior was trained under."""
        return self.config.sampling.distribution if self.remembers_rooms else "paper"


@dataclass(frozen=True)
class TrainedSampler:
    """A trained method that makes rooms of boxes from a seed alone: no room has a latent, and no
    object a mesh."""

    prior: Atiss | Sync2Gen
    room_ids: tuple[str, ...]
    config: RunConfig
    stage: str

    remembers_rooms = False


def stages_of(config: RunConfig) -> tuple[str, ...]:
    """The stages that a run trains, in order."""
    return STAGES_OF[config.stages]


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
        raise _misfit(path, error) from None
    return prior, latents, room_ids


def restore_sampler(
    config: RunConfig, stage: str, path: Path
) -> tuple[Atiss | Sync2Gen, tuple[str, ...]]:
    """Network and room ids of a checkpoint of a stage of `SAMPLERS`.

    Raises:
        InputError: the checkpoint is of another network.
    """
    saved = read_checkpoint(path)
    try:
        prior: Atiss | Sync2Gen = SAMPLERS[stage](config)
        nn.ModuleDict({"prior": prior}).load_state_dict(saved["state_dict"])
        return prior, tuple(saved["sceneprior"]["room_ids"])
    except (KeyError, RuntimeError) as error:
        raise _misfit(path, error) from None


def _misfit(path: Path, error: Exception) -> InputError:
    reason = " ".join(str(error).split())[:200]
    return InputError(
        f"{path} does not fit the run's config.yaml ({reason}); use the config it was trained with."
    )


def load_any_run(run: Path, checkpoint: str = "final") -> TrainedPrior | TrainedSampler:
    """What a run of any kind trained, in evaluation mode; `checkpoint` as in `find_checkpoint`.

    For tasks that only want new rooms (`tasks.decode.synthesize`).

    Raises:
        InputError: the folder is no run, or its checkpoint is missing or damaged.
    """
    run = Path(run)
    stage, path = find_checkpoint(run, checkpoint)
    config = load_config(str(run / "config.yaml"))
    if stage in SAMPLERS:
        sampler, room_ids = restore_sampler(config, stage, path)
        return TrainedSampler(sampler.eval().requires_grad_(False), room_ids, config, stage)
    prior, latents, room_ids = restore(config, path)
    return TrainedPrior(
        prior.eval().requires_grad_(False), latents.weight.detach(), room_ids, config, stage
    )


def load_run(run: Path, checkpoint: str = "final") -> TrainedPrior:
    """The trained prior of a run, in evaluation mode: for tasks that need its latent space.

    Raises:
        InputError: the folder is no run, its checkpoint is missing or damaged, or it is the run of
            a baseline without a latent space.
    """
    trained = load_any_run(run, checkpoint)
    if isinstance(trained, TrainedSampler):
        raise InputError(
            f"{run} is a run of `stages: {trained.config.stages}`, which has no latent space of "
            "rooms, and this needs one. Take a run of `stages: two`; with this one, `sceneprior "
            "synthesize`, `eval-fid` and `report` work."
        )
    return trained

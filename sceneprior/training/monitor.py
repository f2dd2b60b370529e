"""Choosing checkpoints by what they generate: look now and then, log, keep the best.

What a look is, is not known here: `fit` is handed a `Judge`, since generating and scoring are
above training (docs/architecture.md). `experiments/evaluate_samples.py` makes
the one that the command uses.
"""

import copy
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
from jaxtyping import UInt8
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger
from numpy import ndarray
from PIL import Image

from sceneprior.config import RunConfig
from sceneprior.errors import InputError
from sceneprior.training.callbacks import write_checkpoint
from sceneprior.training.checkpoints import SAMPLERS, TrainedPrior, TrainedSampler

LOW_IS_BETTER = ("category_kl", "objects_off", "overlaps")
"""Of the metrics that `samples.metric` may name; of the others high is better."""


@dataclass(frozen=True)
class EvaluationResult:
    """What a look at a prior says."""

    scores: Mapping[str, float]
    """By name, finite or NaN; logged as `samples/<name>`."""
    picture: UInt8[ndarray, "height width 3"]
    against: str
    """The split that the scores compare with."""


Judge = Callable[[TrainedPrior | TrainedSampler], EvaluationResult]


class SampleMonitor(Callback):
    """Every few epochs, and after the last one, judge the prior as it stands.

    Leaves `samples/<epoch>.png` (whatever the loggers), `samples.json` (the newest scores, the
    best, and what they compare with) and `best.ckpt`. Training goes on as if nobody had looked:
    a copy of the network is judged, on the CPU, and each batch has a seed of its own.

    Of several processes the first looks; the others wait for what it tells them, its errors
    included. The best so far is part of every checkpoint, so a resumed run goes on choosing where
    it stopped.

    Args:
        folder: Of the stage.
        config: The run's; its section `samples` says when and by what.
        stage: Of `STAGES`.
        room_ids: Of the training rooms.
        judge: Takes the look.
    """

    def __init__(
        self, folder: Path, config: RunConfig, stage: str, room_ids: tuple[str, ...], judge: Judge
    ):
        self.folder, self.config, self.stage = folder, config, stage
        self.room_ids, self.judge = room_ids, judge
        self.best: float | None = None
        self.best_epoch: int | None = None

    def state_dict(self) -> dict[str, Any]:
        return {"best": self.best, "best_epoch": self.best_epoch}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best, self.best_epoch = state_dict["best"], state_dict["best_epoch"]

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        done = trainer.current_epoch + 1
        if done % self.config.samples.every and done != trainer.max_epochs:
            return
        told: tuple[dict[str, float], str] = ({}, "")
        problem: Exception | None = None
        if trainer.is_global_zero:
            try:
                verdict = self.judge(self._prior_of(pl_module))
                told = (dict(verdict.scores), "")
                self._show(trainer, verdict, done)
            except Exception as error:
                problem = error
                told = ({}, f"{type(error).__name__}: {error}")
        # Whoever waits here must hear of a failure, or waits for ever.
        scores, trouble = trainer.strategy.broadcast(told)
        if problem is not None:
            raise problem
        if trouble:
            raise InputError(f"Judging generated rooms failed in the first process: {trouble}")
        for name, score in scores.items():
            pl_module.log(f"samples/{name}", score, on_epoch=True, rank_zero_only=True)
        if self._is_best(scores):
            self.best, self.best_epoch = scores[self.config.samples.metric], done
            write_checkpoint(trainer, self.folder, "best.ckpt")
        if trainer.is_global_zero:
            self._note(verdict, done)

    def _prior_of(self, module: Any) -> TrainedPrior | TrainedSampler:
        prior = copy.deepcopy(module.prior).cpu().eval().requires_grad_(False)
        if self.stage in SAMPLERS:
            return TrainedSampler(prior, self.room_ids, self.config, self.stage)
        logits = module.latents.weight.detach().cpu().clone()
        return TrainedPrior(prior, logits, self.room_ids, self.config, self.stage)

    def _is_best(self, scores: Mapping[str, float]) -> bool:
        metric = self.config.samples.metric
        if metric not in scores:
            raise InputError(
                f"samples.metric is {metric}, but a look gave only {', '.join(scores)}; name one "
                "of these."
            )
        score = scores[metric]
        if math.isnan(score) or self.best is None:
            return not math.isnan(score)
        return score < self.best if metric in LOW_IS_BETTER else score > self.best

    def _show(self, trainer: lightning.Trainer, verdict: EvaluationResult, done: int) -> None:
        folder = self.folder / "samples"
        folder.mkdir(exist_ok=True)
        Image.fromarray(verdict.picture).save(folder / f"{done:05d}.png")
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image(
                    "samples", verdict.picture, trainer.global_step, dataformats="HWC"
                )
            elif isinstance(logger, WandbLogger):
                logger.log_image("samples", [verdict.picture], trainer.global_step)

    def _note(self, verdict: EvaluationResult, done: int) -> None:
        metric = self.config.samples.metric
        note = {
            "epoch": done,
            "scores": {k: None if math.isnan(v) else v for k, v in verdict.scores.items()},
            "compared_with": f"{verdict.against} rooms",
            "best": {"metric": metric, "score": self.best, "epoch": self.best_epoch},
        }
        part = self.folder / "samples.json.part"
        part.write_text(json.dumps(note, indent=2) + "\n")
        part.replace(self.folder / "samples.json")

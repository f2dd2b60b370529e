"""Choosing checkpoints by what they generate: evaluate now and then, log, keep the best.

How samples are scored is not known here: `fit` is handed a function, since generating and scoring
are above training (docs/architecture.md). `experiments/evaluate_samples.py` makes the one that the
command uses.
"""

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

from sceneprior.errors import InputError
from sceneprior.files import write_json, write_whole
from sceneprior.pictures import png_bytes
from sceneprior.training.checkpoints import write_checkpoint
from sceneprior.training.method import RunConfig, Trained

LOW_IS_BETTER = ("category_kl", "objects_off", "overlaps")
"""Of the metrics that `samples.metric` may name; of the others high is better."""


@dataclass(frozen=True)
class EvaluationResult:
    """Scores and a picture of what a prior generates."""

    scores: Mapping[str, float]
    """By name, finite or NaN; logged as `samples/<name>`."""
    picture: UInt8[ndarray, "height width 3"]
    against: str
    """The split that the scores compare with."""


Evaluate = Callable[[Trained], EvaluationResult]


class SampleMonitor(Callback):
    """Every few epochs, and after the last one, evaluate the prior as it stands.

    Leaves `samples/<epoch>.png` (whatever the loggers), `samples.json` (the newest scores, the
    best, and what they compare with) and `best.ckpt`. Training goes on as if nothing had been
    evaluated: it is done on a copy of the network, on the CPU, and each batch has its own seed.

    Of several processes the first evaluates; the others wait for its scores, or its error. The
    best so far is part of every checkpoint, so a resumed run goes on choosing where it stopped.
    The config's section `samples` says when and by what.
    """

    def __init__(
        self,
        folder: Path,
        config: RunConfig,
        stage: str,
        room_ids: tuple[str, ...],
        evaluate: Evaluate,
    ):
        self.folder, self.config, self.stage = folder, config, stage
        self.room_ids, self.evaluate = room_ids, evaluate
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
                result = self.evaluate(self.config.trained(pl_module, self.stage, self.room_ids))
                told = (dict(result.scores), "")
                self._show(trainer, result, done)
            except Exception as error:
                problem = error
                told = ({}, f"{type(error).__name__}: {error}")
        # A process that waits here must be told of a failure, or waits for ever.
        scores, trouble = trainer.strategy.broadcast(told)
        if problem is not None:
            raise problem
        if trouble:
            raise InputError(f"Evaluating generated rooms failed in the first process: {trouble}")
        for name, score in scores.items():
            pl_module.log(f"samples/{name}", score, on_epoch=True, rank_zero_only=True)
        if self._is_best(scores):
            self.best, self.best_epoch = scores[self.config.samples.metric], done
            write_checkpoint(trainer, self.folder, "best.ckpt")
        if trainer.is_global_zero:
            self._note(result, done)

    def _is_best(self, scores: Mapping[str, float]) -> bool:
        metric = self.config.samples.metric
        if metric not in scores:
            raise InputError(
                f"samples.metric is {metric}, but there are only {', '.join(scores)}; name one "
                "of these."
            )
        score = scores[metric]
        if math.isnan(score) or self.best is None:
            return not math.isnan(score)
        return score < self.best if metric in LOW_IS_BETTER else score > self.best

    def _show(self, trainer: lightning.Trainer, result: EvaluationResult, done: int) -> None:
        write_whole(self.folder / "samples" / f"{done:05d}.png", png_bytes(result.picture))
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image(
                    "samples", result.picture, trainer.global_step, dataformats="HWC"
                )
            elif isinstance(logger, WandbLogger):
                logger.log_image("samples", [result.picture], trainer.global_step)

    def _note(self, result: EvaluationResult, done: int) -> None:
        metric = self.config.samples.metric
        note = {
            "epoch": done,
            "scores": {k: None if math.isnan(v) else v for k, v in result.scores.items()},
            "compared_with": f"{result.against} rooms",
            "best": {"metric": metric, "score": self.best, "epoch": self.best_epoch},
        }
        write_json(self.folder / "samples.json", note)

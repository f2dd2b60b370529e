"""Sections of a run's YAML that the lifted method adds: its loss, its first stage, sampling."""

from typing import Literal

from pydantic import Field

from sceneprior.core.settings import Section
from sceneprior.paper.settings import LatentStageConfig


class LiftedLossConfig(Section):
    """Weights of the losses against lifted boxes and shapes."""

    class_: float = Field(1.0, ge=0, alias="class")
    box: float = Field(5.0, ge=0)
    completeness: float = Field(1.0, ge=0)
    shape: float = Field(2.0, ge=0)
    """Weight of the distance between decoded and lifted shapes."""
    latents: float = Field(0.0, ge=0)
    """Weight of the sliced Wasserstein distance between the training rooms' logits and N(0, 1),
    from which the logits of new rooms are sampled; with it, a larger part of the sphere decodes
    into rooms."""
    match_box: float = Field(5.0, ge=0)
    """lambda_B of the matching cost."""


class LiftedStageConfig(LatentStageConfig):
    """Training of the network and latents on lifted boxes and shapes at once. The learning rate
    follows a cosine."""

    decoder_learning_rate: float | None = Field(None, gt=0)
    """Learning rate of the shape decoder; None takes `learning_rate`."""

    @property
    def shape_rate(self) -> float:
        return self.decoder_learning_rate or self.learning_rate


class LiftedSamplingConfig(Section):
    """Sampling of new rooms."""

    distribution: Literal["sampler", "kernel", "paper"] = "paper"
    """`sampler`: drawn object by object, without a latent (needs the section `sampler`). The others
    are distributions of latents, as in a run of the paper's method."""

"""Runs of the paper's and the lifted method whose decoder of object features is a baseline's."""

from typing import Annotated

from pydantic import Field

from sceneprior.baselines.decoders import Atiss2dConfig, LstmConfig
from sceneprior.lifted.config import LiftedConfig, LiftedModel
from sceneprior.paper.config import PaperConfig, PaperModel
from sceneprior.paper.transformer import TransformerConfig

Decoder = Annotated[TransformerConfig | LstmConfig | Atiss2dConfig, Field(discriminator="name")]


class AnyPaperModel(PaperModel):
    """The paper's network with any decoder."""

    decoder: Decoder  # type: ignore[assignment]


class PaperRun(PaperConfig):
    """Config of a run of the paper's method with any decoder."""

    model: AnyPaperModel


class AnyLiftedModel(LiftedModel):
    """The network of the lifted method with any decoder."""

    decoder: Decoder  # type: ignore[assignment]


class LiftedRun(LiftedConfig):
    """Config of a run of the lifted method with any decoder."""

    model: AnyLiftedModel

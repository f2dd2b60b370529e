"""The section `sampler` of a run's YAML."""

from pydantic import Field, model_validator

from sceneprior.training.method import TrainConfig


class SamplerConfig(TrainConfig):
    """Training and size of the sampler."""

    batch_size: int = Field(64, ge=1)
    learning_rate: float = Field(1e-3, gt=0)
    weight_decay: float = Field(0.01, ge=0)
    clip_gradient: float = Field(1.0, ge=0)
    width: int = Field(128, ge=8)
    """Width of the transformer encoder; its feed-forward layers are twice as wide."""
    layers: int = Field(2, ge=1, le=100)
    heads: int = Field(4, ge=1)
    dropout: float = Field(0.1, ge=0, lt=1)
    val_every: int = Field(10, ge=1)
    """Epochs between evaluations on the val rooms. The network that gives them the highest
    likelihood is kept, or the newest network if there are no val rooms."""

    @model_validator(mode="after")
    def _heads_divide_width(self) -> "SamplerConfig":
        if self.width % self.heads:
            raise ValueError(f"width {self.width} is not a multiple of heads {self.heads}")
        return self

"""The section `sampler` of a run's YAML."""

from pydantic import Field, model_validator

from sceneprior.training.settings import TrainConfig


class SamplerConfig(TrainConfig):
    """How the sampler is trained, and its size."""

    batch_size: int = Field(64, ge=1)
    learning_rate: float = Field(1e-3, gt=0)
    weight_decay: float = Field(0.01, ge=0)
    clip_gradient: float = Field(1.0, ge=0)
    width: int = Field(128, ge=8)
    """Of the transformer encoder; its inner layers are twice as wide."""
    layers: int = Field(2, ge=1, le=100)
    heads: int = Field(4, ge=1)
    dropout: float = Field(0.1, ge=0, lt=1)
    val_every: int = Field(10, ge=1)
    """Epochs from one look at the val rooms to the next. What is kept is the network that finds
    them likeliest; the newest where there are none."""

    @model_validator(mode="after")
    def _heads_divide_width(self) -> "SamplerConfig":
        if self.width % self.heads:
            raise ValueError(f"width {self.width} is not a multiple of heads {self.heads}")
        return self

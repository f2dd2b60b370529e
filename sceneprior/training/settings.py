"""Sections of a run's YAML that every method has: data, and the training of a stage."""

from typing import Any

from pydantic import Field

from sceneprior.core.errors import ConfigError
from sceneprior.core.settings import Section, shortened


class DataConfig(Section):
    """The shards, and the part of each room that training uses."""

    shards: str
    """Folder of view shards (any `prep-*` command); relative to the current folder."""
    view_fraction: float = Field(1.0, gt=0, le=1)
    """Share of each room's views that training may use (the paper's Table 4: 0.25, 0.5, 1)."""
    augment_rotations: bool = True
    """Add each room rotated by 90, 180 and 270 degrees, each with its own latent."""
    mask_step: int = Field(4, ge=1)
    """Masks are compared at 1 / mask_step of the rendered resolution (paper: 4)."""
    workers: int = Field(0, ge=0)
    """Loader processes; 0 loads in the training process, which is fastest for small sets."""

    @property
    def rotations(self) -> int:
        """Number of data set rows per room: 4 with augmentation, else 1."""
        return 4 if self.augment_rotations else 1


class ViewDataConfig(DataConfig):
    """The shards, and the number of views of each room that a step uses."""

    views_per_room: int = Field(20, ge=1)
    """Views drawn per room and step (paper: 20), unless a stage overrides it."""


class TrainConfig(Section):
    """Training settings that the stages of all methods share. The optimiser is Adam."""

    epochs: int = Field(ge=1)
    batch_size: int = Field(16, ge=1)
    """Rooms per batch and process."""
    accumulate: int = Field(1, ge=1)
    """Batches whose gradients are averaged before each update."""
    clip_gradient: float = Field(0.0, ge=0)
    """Norm to which gradients are clipped; 0 turns clipping off."""
    cpu_threads: int | None = Field(None, ge=1)
    """Torch threads when training on a CPU; None keeps torch's default. A small network gains
    little from a second thread, and loses much when another program uses that core."""


def without_samples(data: dict[str, Any], source: str) -> dict[str, Any]:
    """The settings of a run without the section `samples`, which runs had until version 0.1.0."""
    samples = data.get("samples", {})
    every = samples.get("every", 0) if isinstance(samples, dict) else samples
    if every != 0:
        raise ConfigError(
            f"{source}: 'samples.every' is {shortened(every)}, but training no longer evaluates "
            "generated rooms; delete the section `samples`. The run's final.ckpt is read as before."
        )
    return {key: value for key, value in data.items() if key != "samples"}

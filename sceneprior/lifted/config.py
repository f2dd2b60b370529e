"""Settings of a run of the lifted method, and its stages, from opened data to a module."""

import warnings
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from pydantic import Field, model_validator
from torch import nn

from sceneprior.core.errors import ConfigError, InputWarning
from sceneprior.core.settings import Section
from sceneprior.core.shards import splits_of
from sceneprior.lifted.lifting import ShapeGrid
from sceneprior.lifted.lifting.dataset import LiftedDataset
from sceneprior.lifted.prototype_decoder import PrototypeConfig, PrototypeDecoder
from sceneprior.lifted.sampler.network import RoomSampler, SamplerConfig
from sceneprior.lifted.sampler.rooms import SamplerRooms
from sceneprior.lifted.trained import SAMPLER, TrainedLifted
from sceneprior.paper.prior import ModelConfig, PriorConfig
from sceneprior.paper.settings import LatentStageConfig
from sceneprior.paper.transformer import TransformerConfig
from sceneprior.training.method import Stage, ready_copy

if TYPE_CHECKING:
    from sceneprior.lifted.sampler.stage import SamplerStage
    from sceneprior.lifted.stages import LiftedStage


FEW_ROOMS = 24
"""Number of training rooms below which training warns: docs/captures.md advises a few dozen."""


class LiftedLossConfig(Section):
    """Weights of the losses against lifted boxes and shapes."""

    class_: float = Field(1.0, ge=0, alias="class")
    """lambda_l of Eq. 7."""
    box: float = Field(5.0, ge=0)
    """lambda_box of Eq. 7, for the distance of 3D boxes; a larger value trades classes for
    positions."""
    completeness: float = Field(1.0, ge=0)
    """lambda_p of Eq. 7, the weight of the number of objects."""
    shape: float = Field(2.0, ge=0)
    """Weight of the distance between decoded and lifted shapes."""
    latents: float = Field(0.0, ge=0)
    """Weight of the sliced Wasserstein distance between the training rooms' logits and N(0, 1),
    from which the logits of new rooms are sampled; with it, a larger part of the sphere decodes
    into rooms."""
    match_box: float = Field(5.0, ge=0)
    """lambda_B of the matching cost: larger values match by position more than by class."""


class LiftedStageConfig(LatentStageConfig):
    """Training of the network and the latents on lifted boxes and shapes, in one stage. The
    learning rate follows a cosine schedule."""

    decoder_learning_rate: float | None = Field(None, gt=0)
    """Learning rate of the shape decoder; None uses `learning_rate`."""


class LiftedSamplingConfig(Section):
    """Sampling of new rooms."""

    distribution: Literal["sampler", "kernel", "paper"] = "paper"
    """`sampler`: rooms are sampled object by object, without a latent (needs the section
    `sampler`). The others are distributions of latents, as in a run of the paper's method."""


class LiftedModel(ModelConfig):
    """The paper's network, with looks (`lifted/prototypes.py`) in place of deformed templates."""

    decoder: TransformerConfig
    shape: PrototypeConfig = PrototypeConfig()


class LiftedConfig(PriorConfig):
    """Config of a run of the lifted method, which estimates 3D boxes and shapes from masks before
    training."""

    method: Literal["lifted"] = "lifted"
    model: LiftedModel
    loss: LiftedLossConfig = LiftedLossConfig()
    shape: LiftedStageConfig
    """Training of the sphere: the paper's network and latents, on lifted boxes and shapes."""
    sampler: SamplerConfig | None = None
    """The autoregressive model that samples new rooms object by object; null for none."""
    sampling: LiftedSamplingConfig = LiftedSamplingConfig()

    remembers_rooms: ClassVar[bool] = True

    @property
    def distribution(self) -> str:
        return self.sampling.distribution

    @property
    def learns_from(self) -> str:
        return "boxes lifted from masks in 2D"

    @model_validator(mode="after")
    def _sampler_is_there(self) -> "LiftedConfig":
        if self.sampler is None and self.sampling.distribution == SAMPLER:
            raise ValueError(
                "sampling.distribution is 'sampler', but there is no section `sampler`; add one "
                "(`sampler: {epochs: 200}`), or choose another distribution"
            )
        return self

    def stages(self) -> tuple[Stage, ...]:
        sphere = Stage("shape", self.shape, self.open_lifted, self._build)
        if self.sampler is None:
            return (sphere,)
        build = partial(self._build_sampler_stage, self.sampler)
        return sphere, Stage("sampler", self.sampler, self._sampler_rooms, build)

    def networks(self, stage: str, rooms: int) -> nn.ModuleDict:
        networks = super().networks(stage, rooms)
        if stage == "sampler" and self.sampler is not None:
            networks["sampler"] = self.build_sampler(self.sampler)
        return networks

    def trained(self, networks: nn.Module, stage: str, room_ids: tuple[str, ...]) -> TrainedLifted:
        plain = super().trained(networks, stage, room_ids)
        sampler = ready_copy(networks.sampler) if hasattr(networks, "sampler") else None
        return TrainedLifted(plain.prior, room_ids, self, stage, plain.logits, sampler)

    def build_sampler(self, settings: SamplerConfig) -> RoomSampler:
        """The sampler's network, freshly initialised from the seed; `teach` sets its buffers."""
        torch.manual_seed(self.seed)
        most = self.model.shape.prototypes
        return RoomSampler(settings, self.classes, most, self.model.max_objects)

    def open_lifted(self, split: str = "train") -> LiftedDataset:
        """Rooms with the 3D boxes and shapes estimated from their masks.

        Raises:
            InputError: the rooms do not fit the config.
        """
        data, shape = self.data, self.model.shape
        grid = ShapeGrid(shape.cells, shape.margin)
        given = (data.rotations, data.view_fraction, self.seed)
        rooms = LiftedDataset(Path(data.shards), split, grid, *given)
        self.check_rooms(rooms, self.model.max_objects)
        return rooms

    def _sampler_rooms(self, split: str = "train") -> SamplerRooms:
        return SamplerRooms(self.open_lifted(split))

    def _build(self, rooms: LiftedDataset, previous: Path | None) -> "LiftedStage":
        # Imported here and below, only where something is trained: Lightning takes seconds.
        from sceneprior.lifted.stages import LiftedStage

        if (count := len(rooms.plain_ids)) < FEW_ROOMS:
            warnings.warn(
                f"The train split has only {count} room{'s' * (count > 1)}, so new rooms will be "
                f"implausible; prepare at least {FEW_ROOMS}, better a few hundred.",
                InputWarning,
                stacklevel=2,
            )
        prior, latents = self.build_prior(), self.build_latents(len(rooms))
        assert isinstance(prior.shape, PrototypeDecoder)
        most = self.model.shape.prototypes
        found = rooms.find_prototypes(most)
        if (least := len(found.object_class)) > most:
            raise ConfigError(
                f"model.shape.prototypes is {most}, but the rooms have objects of {least} classes, "
                f"each of which needs a prototype; set it to {least} or more."
            )
        prior.shape.set_prototypes(found)
        stage = LiftedStage(self, self.shape, prior, latents)
        stage.rooms = rooms
        return stage

    def _build_sampler_stage(
        self, stage: SamplerConfig, rooms: SamplerRooms, previous: Path | None
    ) -> "SamplerStage":
        from sceneprior.lifted.sampler.prototype_statistics import teach
        from sceneprior.lifted.sampler.stage import SamplerStage

        assert previous is not None, "the shape stage comes before"
        before = self.before(previous, rooms.room_ids)
        assert isinstance(before.prior.shape, PrototypeDecoder)
        prototypes = before.prior.shape.prototypes
        sampler = self.build_sampler(stage)
        teach(sampler, rooms.assign_prototypes(prototypes))
        val = None
        if "val" in splits_of(Path(self.data.shards)):  # or else the newest network is kept
            val = self._sampler_rooms("val").assign_prototypes(prototypes, rooms.backs)
            if not val.rooms.is_object.any():
                said = "The val rooms have no object that looks like one of the training rooms'"
                warnings.warn(f"{said}; so the newest network is kept.", InputWarning, 2)
                val = None
        latents = nn.Embedding.from_pretrained(before.logits)
        return SamplerStage(before.prior, latents, sampler, stage, val, self.seed)

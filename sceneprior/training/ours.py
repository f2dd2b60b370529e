"""The paper's method: its settings, and its two stages from opened data to a trained prior."""

import contextlib
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import torch
from pydantic import Field, field_validator, model_validator
from torch import nn

from sceneprior.data.dataset import ViewDataset
from sceneprior.errors import InputError, ShardError
from sceneprior.lifting.dataset import LiftedDataset
from sceneprior.lifting.lifted import ShapeGrid
from sceneprior.models.occupancy import OccupancyConfig, OccupancyDecoder
from sceneprior.sampler.network import RoomSampler
from sceneprior.sampler.rooms import SamplerRooms
from sceneprior.sampler.settings import SamplerConfig
from sceneprior.shards import list_shards
from sceneprior.training.method import PriorConfig, Stage, TrainedPrior
from sceneprior.training.settings import (
    LayoutConfig,
    LiftedShapeConfig,
    LossConfig,
    SamplingConfig,
    ShapeConfig,
    StageConfig,
)

if TYPE_CHECKING:
    import sceneprior.sampler.stage
    import sceneprior.training.stages


class PaperConfig(PriorConfig):
    """A run of the paper's method."""

    method: Literal["ours"] = "ours"
    loss: LossConfig = LossConfig()
    layout: LayoutConfig | None
    """Null trains layout and shape together from the start (ablation c3)."""
    shape: Annotated[ShapeConfig | LiftedShapeConfig, Field(discriminator="supervision")]
    sampler: SamplerConfig | None = None
    """A model of rooms' objects one by one, which makes new rooms; null for none, as the paper."""
    sampling: SamplingConfig = SamplingConfig()

    remembers_rooms: ClassVar[bool] = True

    @property
    def distribution(self) -> str:
        return self.sampling.distribution

    @field_validator("shape", mode="before")
    @classmethod
    def _masks_by_default(cls, shape: Any) -> Any:
        return {"supervision": "masks"} | shape if isinstance(shape, dict) else shape

    @model_validator(mode="after")
    def _shapes_fit(self) -> "PaperConfig":
        needed = "lifted" if self.model.shape.name == "occupancy" else "masks"
        if self.shape.supervision != needed:
            raise ValueError(
                f"model.shape is '{self.model.shape.name}', which is learnt with "
                f"shape.supervision '{needed}', but that is '{self.shape.supervision}'; change "
                "one of them"
            )
        if self.sampler is not None and needed != "lifted":
            raise ValueError(
                "sampler: it learns from shapes that were lifted from masks; set model.shape.name "
                "to occupancy and shape.supervision to lifted, or leave the sampler out"
            )
        if self.sampler is None and self.sampling.distribution == "sampler":
            raise ValueError(
                "sampling.distribution is 'sampler', but there is no section `sampler`; add one "
                "(`sampler: {epochs: 200}`), or choose another distribution"
            )
        return self

    def stages(self) -> tuple[Stage, ...]:
        first = () if self.layout is None else (self._layout_stage(self.layout),)
        last = () if self.sampler is None else (self._sampler_stage(self.sampler),)
        return (*first, self._shape_stage(self.shape), *last)

    def networks(self, stage: str, rooms: int) -> nn.ModuleDict:
        networks = super().networks(stage, rooms)
        if stage == "sampler" and self.sampler is not None:
            networks["sampler"] = self.build_sampler(self.sampler)
        return networks

    def build_sampler(self, settings: SamplerConfig) -> RoomSampler:
        """The sampler's network, freshly initialised from the seed; it knows no rooms yet."""
        assert isinstance(self.model.shape, OccupancyConfig), "checked above"
        torch.manual_seed(self.seed)
        most = self.model.shape.prototypes
        return RoomSampler(settings, self.classes, most, self.model.max_objects)

    def _layout_stage(self, stage: LayoutConfig) -> Stage:
        if stage.supervision == "lifted":
            return Stage("layout", stage, self.open_lifted, partial(self._build, stage))
        boxes = partial(self.open_views, self.data.views_per_room, None)
        return Stage("layout", stage, boxes, partial(self._build, stage))

    def _sampler_stage(self, stage: SamplerConfig) -> Stage:
        return Stage(
            "sampler",
            stage,
            self._sampler_rooms,
            partial(self._build_sampler_stage, stage),
        )

    def _lifted_shapes(self, split: str = "train") -> LiftedDataset:
        assert isinstance(self.model.shape, OccupancyConfig), "checked above"
        return self.open_lifted(ShapeGrid(self.model.shape.cells, self.model.shape.margin), split)

    def _sampler_rooms(self, split: str = "train") -> SamplerRooms:
        return SamplerRooms(self._lifted_shapes(split))

    def _build_sampler_stage(
        self, stage: SamplerConfig, rooms: SamplerRooms, previous: Path | None
    ) -> "sceneprior.sampler.stage.SamplerStage":
        from sceneprior.sampler.stage import SamplerStage, teach

        assert previous is not None, "the shape stage comes before"
        before = self._before(previous, rooms.room_ids)
        assert isinstance(before.prior.shape, OccupancyDecoder)
        prototypes = before.prior.shape.prototypes
        sampler = self.build_sampler(stage)
        teach(sampler, rooms.see_looks(prototypes))
        val = None
        with contextlib.suppress(ShardError):  # no val rooms: the newest network is kept
            list_shards(Path(self.data.shards), "val")
            val = self._sampler_rooms("val").see_looks(prototypes)
        latents = nn.Embedding.from_pretrained(before.logits)
        return SamplerStage(before.prior, latents, sampler, stage, val, self.seed)

    def _shape_stage(self, stage: ShapeConfig | LiftedShapeConfig) -> Stage:
        if isinstance(stage, LiftedShapeConfig):
            return Stage("shape", stage, self._lifted_shapes, partial(self._build, stage))
        views = stage.views_per_room or self.data.views_per_room
        masks = partial(self.open_views, views, self.data.mask_step)
        return Stage("shape", stage, masks, partial(self._build, stage))

    def _build(
        self, stage: StageConfig, rooms: ViewDataset | LiftedDataset, previous: Path | None
    ) -> "sceneprior.training.stages.PaperStage":
        # Imported where something is trained, here and above: Lightning takes seconds.
        from sceneprior.training.stages import LayoutStage, LiftedStage, ShapeStage

        if previous is None:
            prior, latents = self.build_prior(), self.build_latents(len(rooms))
        else:
            before = self._before(previous, rooms.room_ids)
            prior = before.prior.train()
            latents = nn.Embedding.from_pretrained(before.logits, freeze=False)
        if isinstance(stage, LiftedShapeConfig):
            assert isinstance(rooms, LiftedDataset) and isinstance(prior.shape, OccupancyDecoder)
            assert isinstance(self.model.shape, OccupancyConfig)
            prior.shape.learn_prototypes(rooms.find_prototypes(self.model.shape.prototypes))
        target = self.model.completeness_target
        views_alone = LayoutStage if isinstance(stage, LayoutConfig) else ShapeStage
        kind = LiftedStage if isinstance(rooms, LiftedDataset) else views_alone
        return kind(prior, latents, rooms, stage, self.loss, target, self.seed)

    def _before(self, previous: Path, room_ids: tuple[str, ...]) -> TrainedPrior:
        """What the stage before learnt, of the same rooms; else an `InputError`."""
        before = self.load(previous.parent.name, previous)
        assert isinstance(before, TrainedPrior)
        if before.room_ids != room_ids:
            raise InputError(
                f"{self.data.shards} no longer holds the rooms of {previous}; every stage of a run "
                "needs the shards that the first was trained on."
            )
        return before

"""The paper's method: its settings, and its two stages from opened data to a trained prior."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator, model_validator
from torch import nn

from sceneprior.data.dataset import ViewDataset
from sceneprior.errors import InputError
from sceneprior.lifting.dataset import LiftedDataset
from sceneprior.models.occupancy import OccupancyConfig, OccupancyDecoder
from sceneprior.training.method import PriorConfig, Stage, TrainedPrior
from sceneprior.training.settings import (
    LayoutConfig,
    LiftedShapeConfig,
    LossConfig,
    SamplingConfig,
    ShapeConfig,
    StageConfig,
)
from sceneprior.training.stages import LayoutStage, LiftedStage, PaperStage, ShapeStage


class PaperConfig(PriorConfig):
    """A run of the paper's method."""

    method: Literal["ours"] = "ours"
    loss: LossConfig = LossConfig()
    layout: LayoutConfig | None
    """Null trains layout and shape together from the start (ablation c3)."""
    shape: Annotated[ShapeConfig | LiftedShapeConfig, Field(discriminator="supervision")]
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
        return self

    def stages(self) -> tuple[Stage, ...]:
        shape = self._shape_stage(self.shape)
        if self.layout is None:
            return (shape,)
        if self.layout.supervision == "lifted":
            lifted = partial(self._build, LiftedStage, self.layout)
            return Stage("layout", self.layout, self.open_lifted, lifted), shape
        boxes = partial(self.open_views, self.data.views_per_room, None)
        build = partial(self._build, LayoutStage, self.layout)
        return Stage("layout", self.layout, boxes, build), shape

    def _shape_stage(self, stage: ShapeConfig | LiftedShapeConfig) -> Stage:
        if isinstance(stage, LiftedShapeConfig):
            assert isinstance(self.model.shape, OccupancyConfig), "checked above"
            shapes = partial(self.open_lifted, self.model.shape)
            return Stage("shape", stage, shapes, partial(self._build, LiftedStage, stage))
        views = stage.views_per_room or self.data.views_per_room
        masks = partial(self.open_views, views, self.data.mask_step)
        return Stage("shape", stage, masks, partial(self._build, ShapeStage, stage))

    def _build(
        self,
        kind: type[PaperStage],
        stage: StageConfig,
        rooms: ViewDataset | LiftedDataset,
        previous: Path | None,
    ) -> PaperStage:
        if previous is None:
            prior, latents = self.build_prior(), self.build_latents(len(rooms))
        else:
            before = self.load("", previous)
            assert isinstance(before, TrainedPrior)
            if before.room_ids != rooms.room_ids:
                raise InputError(
                    f"{self.data.shards} no longer holds the rooms of {previous}; the shape stage "
                    "needs the shards that the layout stage was trained on."
                )
            prior = before.prior.train()
            latents = nn.Embedding.from_pretrained(before.logits, freeze=False)
        if isinstance(rooms, LiftedDataset) and rooms.space is not None:
            assert isinstance(prior.shape, OccupancyDecoder)
            prior.shape.set_space(*rooms.space)
        target = self.model.completeness_target
        return kind(prior, latents, rooms, stage, self.loss, target, self.seed)

"""The paper's method: its settings, and its two stages from opened data to a trained prior."""

from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

from torch import nn

from sceneprior.data.dataset import ViewDataset
from sceneprior.errors import InputError
from sceneprior.lifting.dataset import LiftedDataset
from sceneprior.training.method import PriorConfig, Stage, TrainedPrior
from sceneprior.training.settings import (
    LayoutConfig,
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
    shape: ShapeConfig
    sampling: SamplingConfig = SamplingConfig()

    remembers_rooms: ClassVar[bool] = True

    @property
    def distribution(self) -> str:
        return self.sampling.distribution

    def stages(self) -> tuple[Stage, ...]:
        views = self.shape.views_per_room or self.data.views_per_room
        masks = partial(self.open_views, views, self.data.mask_step)
        shape = Stage("shape", self.shape, masks, partial(self._build, ShapeStage, self.shape))
        if self.layout is None:
            return (shape,)
        if self.layout.supervision == "lifted":
            lifted = partial(self._build, LiftedStage, self.layout)
            return Stage("layout", self.layout, self.open_lifted, lifted), shape
        boxes = partial(self.open_views, self.data.views_per_room, None)
        build = partial(self._build, LayoutStage, self.layout)
        return Stage("layout", self.layout, boxes, build), shape

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
        target = self.model.completeness_target
        return kind(prior, latents, stage, self.loss, target, self.seed)

"""Settings of a run of the paper's method, and its two stages, from opened data to a module."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from torch import nn

from sceneprior.core.dataset import ViewDataset
from sceneprior.paper.decoders import ShapeDecoderConfig
from sceneprior.paper.prior import ModelConfig, PriorConfig
from sceneprior.paper.settings import (
    LayoutConfig,
    LossConfig,
    SamplingConfig,
    ShapeConfig,
    StageConfig,
)
from sceneprior.paper.transformer import TransformerConfig
from sceneprior.training.method import Stage, ViewDataConfig

if TYPE_CHECKING:
    from sceneprior.paper.stages import LatentStage


class PaperModel(ModelConfig):
    """The paper's network."""

    decoder: TransformerConfig
    shape: ShapeDecoderConfig = ShapeDecoderConfig()


class PaperConfig(PriorConfig):
    """Config of a run of the paper's method."""

    method: Literal["paper"] = "paper"
    model: PaperModel
    data: ViewDataConfig
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
        views = self.data.views_per_room
        boxes = partial(self.open_views, views, None)
        masks = partial(self.open_views, self.shape.views_per_room or views, self.data.mask_step)
        shape = Stage(
            "shape", self.shape, masks, partial(self._build, self.shape), partial(masks, "val")
        )
        if self.layout is None:
            return (shape,)
        build = partial(self._build, self.layout)
        return Stage("layout", self.layout, boxes, build, partial(boxes, "val")), shape

    def _build(
        self, stage: StageConfig, rooms: ViewDataset, previous: Path | None
    ) -> "LatentStage":
        # Imported where something is trained: Lightning takes seconds.
        from sceneprior.paper.stages import LayoutStage, ShapeStage

        if previous is None:
            prior, latents = self.build_prior(), self.build_latents(len(rooms))
        else:
            before = self.before(previous, rooms.room_ids)
            prior = before.prior.train()
            latents = nn.Embedding.from_pretrained(before.logits, freeze=False)
        module = LayoutStage if isinstance(stage, LayoutConfig) else ShapeStage
        return module(self, stage, prior, latents)

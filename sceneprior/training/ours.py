"""The paper's method: its settings, and its two stages from opened data to a trained prior."""

from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

from torch import nn

from sceneprior.data.dataset import ViewDataset
from sceneprior.errors import InputError
from sceneprior.models.prior import ScenePrior
from sceneprior.training.checkpoints import restore_prior
from sceneprior.training.layout import LayoutStage
from sceneprior.training.method import PriorConfig, Stage, TrainedPrior, check_rooms
from sceneprior.training.settings import (
    DataConfig,
    LossConfig,
    SamplingConfig,
    ShapeConfig,
    StageConfig,
)
from sceneprior.training.shape import ShapeStage


class PaperConfig(PriorConfig):
    """A run of the paper's method."""

    method: Literal["ours"] = "ours"
    loss: LossConfig = LossConfig()
    layout: StageConfig | None
    """Null trains layout and shape together from the start (ablation c3)."""
    shape: ShapeConfig
    sampling: SamplingConfig = SamplingConfig()

    remembers_rooms: ClassVar[bool] = True

    @property
    def distribution(self) -> str:
        return self.sampling.distribution

    def stages(self) -> tuple[Stage, ...]:
        shape = Stage("shape", self.shape, self._open_masks, self._build_shape)
        if self.layout is None:
            return (shape,)
        boxes = partial(open_views, self, self.data.views_per_room, None)
        build = partial(self._build_layout, self.layout)
        return Stage("layout", self.layout, boxes, build), shape

    def load(self, stage: str, path: Path) -> TrainedPrior:
        prior, latents, room_ids = restore_prior(self, path)
        prior.eval().requires_grad_(False)
        return TrainedPrior(prior, latents.weight.detach(), room_ids, self, stage)

    def _open_masks(self) -> ViewDataset:
        views = self.shape.views_per_room or self.data.views_per_room
        return open_views(self, views, self.data.mask_step)

    def _build_layout(
        self, stage: StageConfig, rooms: ViewDataset, previous: Path | None
    ) -> LayoutStage:
        prior, latents = self._start(rooms, previous)
        target = self.model.completeness_target
        return LayoutStage(prior, latents, stage, self.loss, target, self.seed)

    def _build_shape(self, rooms: ViewDataset, previous: Path | None) -> ShapeStage:
        prior, latents = self._start(rooms, previous)
        target = self.model.completeness_target
        return ShapeStage(prior, latents, self.shape, self.loss, target, self.seed)

    def _start(self, rooms: ViewDataset, previous: Path | None) -> tuple[ScenePrior, nn.Embedding]:
        if previous is None:
            return self.build_prior(), self.build_latents(len(rooms))
        prior, latents, room_ids = restore_prior(self, previous)
        if room_ids != rooms.room_ids:
            raise InputError(
                f"{self.data.shards} no longer holds the rooms of {previous}; the shape stage "
                "needs the shards that the layout stage was trained on."
            )
        return prior, latents


def open_views(config: PriorConfig, views_per_room: int, mask_step: int | None) -> ViewDataset:
    """The training rooms that a config names.

    Raises:
        InputError: they do not fit the config.
    """
    data: DataConfig = config.data
    rooms = ViewDataset(
        Path(data.shards),
        "train",
        views_per_room=views_per_room,
        rotations=data.rotations,
        view_fraction=data.view_fraction,
        mask_step=mask_step,
        seed=config.seed,
    )
    check_rooms(rooms, config, config.model.max_objects)
    return rooms

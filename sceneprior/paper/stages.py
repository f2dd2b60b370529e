"""The paper's two stages: layouts from 2D boxes (Eq. 7), then shapes from masks as well (Eq. 8)."""

import warnings
from abc import ABC, abstractmethod
from typing import Any

import lightning
import torch
from jaxtyping import Float, Int
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn

from sceneprior.core.errors import InputWarning
from sceneprior.core.views import DecodedScenes, SceneViews
from sceneprior.paper.losses import layout_losses, mask_loss, seen_masks
from sceneprior.paper.matching import Matches, seen_boxes
from sceneprior.paper.prior import ScenePrior
from sceneprior.paper.sampling import example_rooms
from sceneprior.paper.settings import (
    LatentStageConfig,
    LayoutConfig,
    LossConfig,
    ShapeConfig,
    StageConfig,
    Steps,
)
from sceneprior.paper.static_step import StaticStep
from sceneprior.training.graphs import OnHost
from sceneprior.training.steps import (
    batch_seed,
    check_finite,
    full_precision,
    log_losses,
    weighted_sum,
    with_cosine,
)
from sceneprior.training.validation import ValidatedModule


class LatentStage(ValidatedModule, ABC):
    """A stage that trains the network, and the latents: one row of logits per training room.

    `config` is the run's, and `stage` its section of this stage.
    """

    examples = staticmethod(example_rooms)

    def __init__(
        self, config: Any, stage: LatentStageConfig, prior: ScenePrior, latents: nn.Embedding
    ):
        super().__init__()
        # DDP expects a gradient of every parameter that requires one.
        prior.requires_grad_(True)
        prior.shape.requires_grad_(not isinstance(stage, LayoutConfig))
        boxes_from = getattr(stage, "box_from", "proxy"), getattr(stage, "proxy", None)
        prior.bevels.requires_grad_(boxes_from == ("proxy", "beveled_box"))
        self.prior, self.latents, self.stage = prior, latents, stage
        self.loss, self.seed = config.loss, config.seed
        self.completeness_target = config.model.completeness_target

    @abstractmethod
    def training_step(self, views: Any, batch_idx: int) -> Tensor:
        """The loss of a batch."""

    def room_latents(
        self, room_index: Int[Tensor, " rooms"], batch_idx: int
    ) -> Float[Tensor, "rooms width"]:
        """The rooms' latents z, each moved by a random step whose length the stage's settings
        `latent_noise` and `latent_noise_end` determine."""
        stage, space = self.stage, self.prior.latent_space
        end = stage.latent_noise if stage.latent_noise_end is None else stage.latent_noise_end
        done = self.current_epoch / stage.epochs
        noise = stage.latent_noise + done * (end - stage.latent_noise)
        with full_precision(self.device):
            z = space(self.latents(room_index.clamp(min=0)))
            if not (noise and self.training):
                return z
            return space.step(z, noise, batch_seed(self.seed, self.trainer, batch_idx))

    def total(self, losses: dict[str, Tensor], rooms: int, **beside: Tensor) -> Tensor:
        """The weighted sum of the losses of a batch of `rooms`, logged; `beside` is logged, not
        summed."""
        total = weighted_sum(losses, self.loss)
        log_losses(self, losses | beside, total, rooms)
        return total

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """Adam with the stage's schedule and three learning rates: for the network, for the shape
        decoder, and for latents and bevels."""
        stage, others = self.stage, ("shape.", "bevels.")
        trained = [p for name, p in self.prior.named_parameters() if not name.startswith(others)]
        tables = [*self.latents.parameters(), *self.prior.bevels.parameters()]
        groups = [
            {"params": trained, "lr": stage.learning_rate},
            {"params": self.prior.shape.parameters(), "lr": stage.shape_rate},
            {"params": tables, "lr": stage.latent_learning_rate},
        ]
        optimizer = torch.optim.Adam(groups, fused=True)
        if isinstance(stage, StageConfig) and isinstance(stage.schedule, Steps):
            drops = torch.optim.lr_scheduler.MultiStepLR(
                optimizer, list(stage.schedule.milestones), gamma=stage.schedule.decay
            )
            return {"optimizer": optimizer, "lr_scheduler": drops}
        return with_cosine(optimizer, int(self.trainer.estimated_stepping_batches))


class PaperStage(LatentStage):
    """A stage of the paper, whose step may have static shapes on a GPU.

    Such a step waits for the GPU once, and its loss is checked when the next step begins.
    """

    stage: StageConfig
    loss: LossConfig
    static: StaticStep | None = None
    _unchecked: tuple[OnHost, tuple[str, ...]] | None = None

    def use_graphs(self, trainer: lightning.Trainer) -> bool:
        """Use CUDA graphs if the settings and the trainer allow; says why not on a GPU."""
        on_gpu = trainer.strategy.root_device.type == "cuda"
        if not (on_gpu and self.stage.cuda_graphs):
            return False
        if trainer.world_size > 1 or trainer.accumulate_grad_batches > 1:
            cause = "several processes train together"
            if trainer.world_size == 1:
                cause = "gradients of several batches are averaged"
            warnings.warn(
                f"{cause[0].upper()}{cause[1:]}, so steps are not captured as CUDA graphs.",
                InputWarning,
                stacklevel=2,
            )
            return False
        self.static = StaticStep(self.prior, self.stage, self.loss, self.completeness_target)
        return True

    def on_before_batch_transfer(self, batch: SceneViews, dataloader_idx: int) -> SceneViews:
        static = self.static if self.training else None  # validation takes plain steps
        return batch if static is None else static.padded(batch)

    def training_step(self, views: SceneViews, batch_idx: int) -> Tensor:
        if self.static is None or not self.training:
            return self.eager_step(views, batch_idx)
        self._check_last()
        z = self.room_latents(views.room_index, batch_idx)
        self.static.prepare(z, views)
        total = self.static_step(self.static, z, views)
        self._unchecked = OnHost(total), views.room_ids
        if self.trainer.is_last_batch:  # before the epoch's checkpoint
            self._check_last()
        return total

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        if self.current_epoch >= self.stage.epochs - self.stage.latent_epochs:
            for parameter in self.prior.parameters():
                parameter.grad = None  # not trained

    def on_train_end(self) -> None:
        self._check_last()  # training may end within an epoch

    def _check_last(self) -> None:
        if self._unchecked is not None:
            total, room_ids = self._unchecked
            self._unchecked = None
            check_finite(total.read()[0], room_ids)

    @abstractmethod
    def eager_step(self, views: SceneViews, batch_idx: int) -> Tensor:
        """The loss of a batch."""

    @abstractmethod
    def static_step(self, static: StaticStep, z: Tensor, views: SceneViews) -> Tensor:
        """The loss of a padded batch with the latents z."""


class LayoutStage(PaperStage):
    """Trains with the layout loss L_L, without decoding shapes (section 3.4, Eq. 7)."""

    stage: LayoutConfig

    def static_step(self, static: StaticStep, z: Tensor, views: SceneViews) -> Tensor:
        scenes, _ = static.layouts(z)
        with full_precision(self.device):
            boxes = static.boxes(scenes, views)
            matches = static.matches(static.cost(scenes, boxes, views), views)
            losses = static.losses(scenes, boxes, views, matches)
            return self.total(losses, len(views.room_ids))

    def eager_step(self, views: SceneViews, batch_idx: int) -> Tensor:
        scenes = self.prior.decode(self.room_latents(views.room_index, batch_idx), False)
        with full_precision(self.device):
            boxes = seen_boxes(scenes, views, self.stage.proxy)
            losses, _ = layout_losses(scenes, boxes, views, self.loss, self.completeness_target)
            return self.total(losses, len(views.room_index))


class ShapeStage(PaperStage):
    """Trains with the layout loss of deformed meshes and the mask loss: L = L_L + lambda_S L_S."""

    stage: ShapeConfig

    def static_step(self, static: StaticStep, z: Tensor, views: SceneViews) -> Tensor:
        scenes, shared = static.layouts(z)
        scenes = self.prior.shape.add_shapes(scenes, shared, views.object_places, None)
        with full_precision(self.device):
            boxes = static.boxes(scenes, views, self.stage.box_from)
            cost = static.cost(scenes, boxes, views)
            masks = self._masks(scenes, views)  # drawn while the host solves the assignment
            matches = static.matches(cost, views)
            losses = static.losses(scenes, boxes, views, matches)
            losses["mask"], overlap = self._mask_loss(masks, views, matches)
            return self.total(losses, len(views.room_ids), **overlap)

    def _masks(self, scenes: DecodedScenes, views: SceneViews) -> Tensor:
        faces = self.prior.shape.faces
        assert scenes.vertices_m is not None and faces is not None, "masks are of meshes"
        return seen_masks(scenes.vertices_m, faces, views, self.stage)

    def _mask_loss(self, masks: Tensor, views: SceneViews, matches: Matches) -> Any:
        gate, passing_only = self.loss.iou_gate, self.loss.passing_masks_only
        return mask_loss(masks, views, matches, gate, passing_only=passing_only)

    def eager_step(self, views: SceneViews, batch_idx: int) -> Tensor:
        # In a room of n objects, only the first n predictions are matched and rendered.
        z = self.room_latents(views.room_index, batch_idx)
        scenes = self.prior.decode(z, views.object_places)
        with full_precision(self.device):
            boxes = seen_boxes(scenes, views, self.stage.proxy, self.stage.box_from)
            losses, matches = layout_losses(
                scenes, boxes, views, self.loss, self.completeness_target
            )
            masks = self._masks(scenes, views)
            losses["mask"], overlap = self._mask_loss(masks, views, matches)
            total = self.total(losses, len(views.room_index), **overlap)
            check_finite(total, views.room_ids)
            return total

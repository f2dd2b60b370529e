"""Stage 1: learn where objects are and what they are, from 2D boxes alone."""

from dataclasses import replace

import lightning
import torch
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn

from sceneprior.batches import SceneViews
from sceneprior.classes import label_set
from sceneprior.config import RunConfig
from sceneprior.losses.overlap import OverlapAllowance
from sceneprior.models.camera_correction import CameraCorrection
from sceneprior.models.scene_prior import ScenePrior
from sceneprior.stages.view_loss import (
    batch_number,
    build_optimizer,
    check_finite,
    full_precision,
    match_and_score,
    proxy_boxes,
    step_seed,
    training_latents,
    weighted_sum,
)


class LayoutStage(lightning.LightningModule):
    """The layout loss of section 3.4, without shape decoding.

    Args:
        prior: The network; its shape decoder is left alone.
        latents: One row of logits a training room.
        config: The run.
    """

    def __init__(
        self, prior: ScenePrior, latents: nn.Embedding, config: RunConfig, views: int = 0
    ):
        super().__init__()
        scale = config.layout.camera_correction
        self.cameras = CameraCorrection(views, scale) if scale else None
        classes = len(label_set(config.label_set))
        self.overlap = OverlapAllowance(classes) if config.loss.overlap else None
        # Several processes agree on gradients only of what takes part.
        prior.shape.requires_grad_(False)
        self.prior = prior
        self.latents = latents
        self.config = config

    def training_step(self, views: SceneViews, batch_idx: int) -> Tensor:
        settings = self.config.layout
        batch = batch_number(self.trainer, batch_idx)
        seed = step_seed(self.config.seed, batch, self.global_rank)
        z = training_latents(
            self.prior,
            self.latents,
            views.room_index,
            settings,
            self.current_epoch / settings.epochs,
            seed,
        )
        scenes = self.prior.decode(z, with_shape=False)
        with full_precision(self.device):
            moved = None
            if self.cameras is not None:
                poses, moved = self.cameras(views.world_to_camera, views.view_index)
                views = replace(views, world_to_camera=poses)
            boxes = proxy_boxes(scenes, views, settings.proxy)
            losses, _ = match_and_score(scenes, boxes, views, self.config.loss)
            if self.overlap is not None:
                losses["overlap"] = self._overlap(seed)
            total = weighted_sum(losses, self.config.loss)
            if moved is not None:
                total = total + 0.05 * moved
        check_finite(total, views)
        named = {f"train/{name}": loss.detach() for name, loss in losses.items()}
        named["train/loss"] = total.detach()
        self.log_dict(
            named, on_step=False, on_epoch=True, batch_size=len(views.room_index), sync_dist=True
        )
        return total

    def _overlap(self, seed):
        from sceneprior.tasks.sampling import sample_logits
        from sceneprior.losses.completeness import kept_objects
        target = self.config.loss.completeness_target
        logits = self.latents.weight
        with torch.no_grad():
            known = self.prior(logits[:64].detach(), with_shape=False)
            self.overlap.observe(known, kept_objects(known.completeness_logits, target))
        new = self.prior(sample_logits(logits.detach(), 32, seed, "kernel"), with_shape=False)
        return self.overlap(new, kept_objects(new.completeness_logits, target))

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        steps = int(self.trainer.estimated_stepping_batches)
        return build_optimizer(self.prior, self.latents, self.config.layout, steps, self.cameras)

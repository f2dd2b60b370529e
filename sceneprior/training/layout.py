"""Stage 1: learn where objects are and what they are, from 2D boxes alone."""

import lightning
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn

from sceneprior.config import RunConfig
from sceneprior.models.prior import ScenePrior
from sceneprior.training.objective import (
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
from sceneprior.views import SceneViews


class LayoutStage(lightning.LightningModule):
    """The layout loss of section 3.4, without shape decoding.

    Args:
        prior: The network; its shape decoder is left alone.
        latents: One row of logits a training room.
        config: The run.
    """

    def __init__(self, prior: ScenePrior, latents: nn.Embedding, config: RunConfig):
        super().__init__()
        # Several processes agree on gradients only of what takes part.
        prior.shape.requires_grad_(False)
        prior.bevels.requires_grad_(config.layout.proxy == "beveled_box")
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
            boxes = proxy_boxes(scenes, views, settings.proxy)
            losses, _ = match_and_score(scenes, boxes, views, self.config.loss)
            total = weighted_sum(losses, self.config.loss)
        check_finite(total, views)
        named = {f"train/{name}": loss.detach() for name, loss in losses.items()}
        named["train/loss"] = total.detach()
        self.log_dict(
            named, on_step=False, on_epoch=True, batch_size=len(views.room_index), sync_dist=True
        )
        return total

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        steps = int(self.trainer.estimated_stepping_batches)
        return build_optimizer(self.prior, self.latents, self.config.layout, steps)

"""Stage 1: learn where objects are and what they are, from 2D boxes alone (Eq. 7)."""

import lightning
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn

from sceneprior.models.prior import ScenePrior
from sceneprior.training.objective import (
    build_optimizer,
    check_finite,
    full_precision,
    log_losses,
    match_and_score,
    proxy_boxes,
    training_latents,
    weighted_sum,
)
from sceneprior.training.settings import LossConfig, StageConfig
from sceneprior.views import SceneViews


class LayoutStage(lightning.LightningModule):
    """The layout loss L_L of section 3.4 (Eq. 7), without shape decoding.

    Args:
        prior: The network; its shape decoder is left alone.
        latents: One row of logits a training room.
        stage, loss: How it is trained, and the weights of the terms.
        completeness_target: Of the model.
        seed: Of the run.
    """

    def __init__(
        self,
        prior: ScenePrior,
        latents: nn.Embedding,
        stage: StageConfig,
        loss: LossConfig,
        completeness_target: str,
        seed: int,
    ):
        super().__init__()
        # Several processes agree on gradients only of what takes part.
        prior.shape.requires_grad_(False)
        prior.bevels.requires_grad_(stage.proxy == "beveled_box")
        self.prior, self.latents = prior, latents
        self.stage, self.loss, self.seed = stage, loss, seed
        self.completeness_target = completeness_target

    def training_step(self, views: SceneViews, batch_idx: int) -> Tensor:
        z = training_latents(self, views.room_index, self.stage, self.seed, batch_idx)
        scenes = self.prior.decode(z, with_shape=False)
        with full_precision(self.device):
            boxes = proxy_boxes(scenes, views, self.stage.proxy)
            losses, _ = match_and_score(scenes, boxes, views, self.loss, self.completeness_target)
            total = weighted_sum(losses, self.loss)
        check_finite(total, views)
        log_losses(self, losses, total, len(z))
        return total

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        steps = int(self.trainer.estimated_stepping_batches)
        return build_optimizer(self.prior, self.latents, self.stage, steps)

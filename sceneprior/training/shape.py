"""Stage 2: layout and shape together, from 2D boxes and silhouettes (Eq. 7 and 8)."""

import lightning
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn

from sceneprior.losses.shape import mask_loss
from sceneprior.models.prior import ScenePrior
from sceneprior.training.objective import (
    build_optimizer,
    check_finite,
    full_precision,
    log_losses,
    match_and_score,
    seen_boxes,
    seen_masks,
    training_latents,
    weighted_sum,
)
from sceneprior.training.settings import LossConfig, ShapeConfig
from sceneprior.views import SceneViews


class ShapeStage(lightning.LightningModule):
    """The layout loss, now of deformed meshes, plus the mask loss: L = L_L + lambda_S L_S.

    Args:
        prior: The network as the layout stage left it; a fresh one where there is one stage alone.
        latents: Its latents.
        stage, loss: How it is trained, and the weights of the terms.
        completeness_target: Of the model.
        seed: Of the run.
    """

    def __init__(
        self,
        prior: ScenePrior,
        latents: nn.Embedding,
        stage: ShapeConfig,
        loss: LossConfig,
        completeness_target: str,
        seed: int,
    ):
        super().__init__()
        self.prior, self.latents = prior.requires_grad_(True), latents
        # Several processes agree on gradients only of what takes part.
        prior.bevels.requires_grad_((stage.box_from, stage.proxy) == ("proxy", "beveled_box"))
        self.stage, self.loss, self.seed = stage, loss, seed
        self.completeness_target = completeness_target

    def training_step(self, views: SceneViews, batch_idx: int) -> Tensor:
        z = training_latents(self, views.room_index, self.stage, self.seed, batch_idx)
        scenes = self.prior.decode(z)
        with full_precision(self.device):
            boxes = seen_boxes(scenes, views, self.stage)
            losses, matches = match_and_score(
                scenes, boxes, views, self.loss, self.completeness_target
            )
            # Before rendering, too, which refuses vertices that are not finite and knows no rooms.
            check_finite(weighted_sum(losses, self.loss), views)
            assert scenes.vertices_m is not None, "decode() adds meshes unless told not to"
            masks = seen_masks(scenes.vertices_m, self.prior.shape.faces, views, self.stage)
            losses["mask"], overlap = mask_loss(masks, views, matches, self.loss.iou_gate)
            total = weighted_sum(losses, self.loss)
        check_finite(total, views)
        log_losses(self, losses | overlap, total, len(z))
        return total

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        steps = int(self.trainer.estimated_stepping_batches)
        return build_optimizer(
            self.prior, self.latents, self.stage, steps, self.stage.decoder_learning_rate
        )

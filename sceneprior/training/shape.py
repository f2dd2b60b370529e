"""Stage 2: layout and shape together, from 2D boxes and silhouettes."""

import lightning
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn

from sceneprior.config import RunConfig
from sceneprior.losses.shape import mask_loss
from sceneprior.models.prior import ScenePrior
from sceneprior.training.objective import (
    batch_number,
    build_optimizer,
    check_finite,
    full_precision,
    match_and_score,
    seen_boxes,
    seen_masks,
    step_seed,
    training_latents,
    weighted_sum,
)
from sceneprior.views import SceneViews


class ShapeStage(lightning.LightningModule):
    """The layout loss, now of deformed meshes, plus the mask loss (equation 8).

    Args:
        prior: The network as the layout stage left it; a fresh one where there is one stage alone.
        latents: Its latents.
        config: The run.
    """

    def __init__(self, prior: ScenePrior, latents: nn.Embedding, config: RunConfig):
        super().__init__()
        self.prior = prior.requires_grad_(True)
        shape = config.shape
        # Several processes agree on gradients only of what takes part.
        prior.bevels.requires_grad_((shape.box_from, shape.proxy) == ("proxy", "beveled_box"))
        self.latents = latents
        self.config = config

    def training_step(self, views: SceneViews, batch_idx: int) -> Tensor:
        settings = self.config.shape
        progress = self.current_epoch / settings.epochs
        batch = batch_number(self.trainer, batch_idx)
        seed = step_seed(self.config.seed, batch, self.global_rank)
        z = training_latents(self.prior, self.latents, views.room_index, settings, progress, seed)
        scenes = self.prior.decode(z)
        with full_precision(self.device):
            boxes = seen_boxes(scenes, views, settings)
            losses, matches = match_and_score(scenes, boxes, views, self.config.loss)
            # Before rendering, too, which refuses vertices that are not finite and knows no rooms.
            check_finite(weighted_sum(losses, self.config.loss), views)
            assert scenes.vertices_m is not None, "decode() adds meshes unless told not to"
            masks = seen_masks(scenes.vertices_m, self.prior.shape.faces, views, settings)
            losses["mask"], overlap = mask_loss(masks, views, matches, self.config.loss.iou_gate)
            total = weighted_sum(losses, self.config.loss)
        check_finite(total, views)
        named = {f"train/{name}": value.detach() for name, value in (losses | overlap).items()}
        named["train/loss"] = total.detach()
        self.log_dict(
            named, on_step=False, on_epoch=True, batch_size=len(views.room_index), sync_dist=True
        )
        return total

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        steps = int(self.trainer.estimated_stepping_batches)
        return build_optimizer(self.prior, self.latents, self.config.shape, steps)

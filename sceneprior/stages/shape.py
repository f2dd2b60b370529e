"""Stage 2: layout and shape together, from 2D boxes and silhouettes."""

import lightning
import torch
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn

from sceneprior.batches import DecodedScenes, SceneViews
from sceneprior.config import RunConfig
from sceneprior.geometry.cameras import Boxes2D, boxes_of_points
from sceneprior.losses.shape import mask_loss, observed_ids
from sceneprior.models.scene_prior import ScenePrior
from sceneprior.silhouettes.render import render_silhouettes
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
        prior.chamfers.requires_grad_((shape.box_from, shape.proxy) == ("proxy", "bulge"))
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
            boxes = self._boxes(scenes, views)
            losses, matches = match_and_score(scenes, boxes, views, self.config.loss)
            # Before rendering, too, which refuses vertices that are not finite and knows no rooms.
            check_finite(weighted_sum(losses, self.config.loss), views)
            masks = self._render(scenes, views)
            losses["mask"], overlap = mask_loss(masks, views, matches, self.config.loss.iou_gate)
            total = weighted_sum(losses, self.config.loss)
        check_finite(total, views)
        named = {f"train/{name}": value.detach() for name, value in (losses | overlap).items()}
        named["train/loss"] = total.detach()
        self.log_dict(
            named, on_step=False, on_epoch=True, batch_size=len(views.room_index), sync_dist=True
        )
        return total

    def _boxes(self, scenes: DecodedScenes, views: SceneViews) -> Boxes2D:
        if self.config.shape.box_from == "proxy" or scenes.vertices_m is None:
            return proxy_boxes(scenes, views, self.config.shape.proxy)
        return boxes_of_points(
            scenes.vertices_m, views.world_to_camera, views.intrinsics, views.image_size
        )

    def _render(self, scenes: DecodedScenes, views: SceneViews) -> Tensor:
        # Only the first n predictions of a room answer for objects; the rest would hide them.
        slots = torch.arange(scenes.centers_m.shape[1], device=scenes.centers_m.device)
        drawn = slots < views.is_object.sum(dim=-1, keepdim=True)
        height, width = observed_ids(views).shape[-2:]
        scale = views.intrinsics.new_tensor(
            [width / views.image_size[1], height / views.image_size[0], 1]
        )
        assert scenes.vertices_m is not None, "decode() adds meshes unless told not to"
        return render_silhouettes(
            scenes.vertices_m,
            self.prior.shape.faces,
            views.world_to_camera,
            views.intrinsics * scale[:, None],
            (height, width),
            sigma_px2=self.config.shape.sigma_px2,
            mode=self.config.shape.silhouettes,
            compositing=self.config.shape.compositing,
            drawn=drawn,
        )

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        steps = int(self.trainer.estimated_stepping_batches)
        return build_optimizer(self.prior, self.latents, self.config.shape, steps)

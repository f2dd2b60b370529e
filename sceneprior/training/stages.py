"""The paper's stages: layouts from 2D boxes (Eq. 7), then with shapes from masks (Eq. 8)."""

from abc import ABC, abstractmethod
from typing import Any

import lightning
import torch
from jaxtyping import Float
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn
from torch.utils.data import Dataset

from sceneprior.lifting.dataset import LiftedDataset
from sceneprior.losses.latents import latent_loss
from sceneprior.losses.lifted import (
    lifted_losses,
    match_lifted,
    needed_predictions,
    shape_code_loss,
)
from sceneprior.losses.shape import mask_loss
from sceneprior.models.occupancy import OccupancyDecoder
from sceneprior.models.prior import ScenePrior
from sceneprior.training.objective import (
    batch_seed,
    check_finite,
    full_precision,
    log_losses,
    match_and_score,
    proxy_boxes,
    seen_boxes,
    seen_masks,
    weighted_sum,
    with_cosine,
)
from sceneprior.training.settings import (
    LayoutConfig,
    LiftedShapeConfig,
    LossConfig,
    ShapeConfig,
    StageConfig,
)
from sceneprior.views import LiftedRooms, SceneViews


class PaperStage(lightning.LightningModule, ABC):
    """What the stages share: latents of the batch's rooms, the end of a step, the optimiser.

    Args:
        prior: The network, as the stage before left it; a fresh one in the first.
        latents: One row of logits a training room.
        rooms: What the stage is trained on.
        stage, loss: How it is trained, and the weights of the terms.
        completeness_target: Of the model.
        seed: Of the run.
    """

    def __init__(
        self,
        prior: ScenePrior,
        latents: nn.Embedding,
        rooms: Dataset[Any],
        stage: StageConfig,
        loss: LossConfig,
        completeness_target: str,
        seed: int,
    ):
        super().__init__()
        # Several processes agree on gradients only of what takes part.
        prior.requires_grad_(True)
        prior.shape.requires_grad_(not isinstance(stage, LayoutConfig))
        prior.bevels.requires_grad_(stage.proxy == "beveled_box" and self.has_proxies(stage))
        self.prior, self.latents, self.rooms = prior, latents, rooms
        self.stage, self.loss, self.seed = stage, loss, seed
        self.completeness_target = completeness_target

    @staticmethod
    def has_proxies(stage: Any) -> bool:
        """Whether 2D boxes of the stage's proxy take part in the loss."""
        return True

    @abstractmethod
    def training_step(self, views: Any, batch_idx: int) -> Tensor:
        """The loss of a batch."""

    def room_latents(
        self, views: SceneViews | LiftedRooms, batch_idx: int
    ) -> Float[Tensor, "rooms width"]:
        """The rooms' latents z, moved at random as far as the stage says."""
        stage, space = self.stage, self.prior.latent_space
        end = stage.latent_noise if stage.latent_noise_end is None else stage.latent_noise_end
        done = self.current_epoch / stage.epochs
        noise = stage.latent_noise + done * (end - stage.latent_noise)
        with full_precision(self.device):
            z = space(self.latents(views.room_index))
            if not noise:
                return z
            return space.step(z, noise, batch_seed(self.seed, self.trainer, batch_idx))

    def total(
        self,
        losses: dict[str, Tensor],
        views: SceneViews | LiftedRooms,
        batch_idx: int,
        beside: dict[str, Tensor] | None = None,
    ) -> Tensor:
        """The weighted sum of the losses, the latents' among them, checked and logged; `beside` is
        logged alone."""
        if self.loss.latents:
            draws = torch.Generator().manual_seed(
                batch_seed(self.seed, self.trainer, batch_idx) + 1  # other numbers than the noise's
            )
            spread = latent_loss(self.latents.weight, self.prior.latent_space.shift_free, draws)
            losses = losses | {"latents": spread}
        total = weighted_sum(losses, self.loss)
        check_finite(total, views)
        log_losses(self, losses | (beside or {}), total, len(views.room_index))
        return total

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """Adam with the stage's schedule; the shape decoder and what each room or class has of its
        own may have other rates."""
        stage, others = self.stage, ("shape.", "bevels.")
        trained = [p for name, p in self.prior.named_parameters() if not name.startswith(others)]
        shape_rate = None
        if isinstance(stage, ShapeConfig | LiftedShapeConfig):
            shape_rate = stage.decoder_learning_rate
        tables = [*self.latents.parameters(), *self.prior.bevels.parameters()]
        groups = [
            {"params": trained, "lr": stage.learning_rate},
            {"params": self.prior.shape.parameters(), "lr": shape_rate or stage.learning_rate},
            {"params": tables, "lr": stage.latent_learning_rate},
        ]
        optimizer = torch.optim.Adam(groups, fused=True)
        if stage.schedule == "cosine":
            return with_cosine(optimizer, int(self.trainer.estimated_stepping_batches))
        drops = torch.optim.lr_scheduler.MultiStepLR(
            optimizer, list(stage.milestones), gamma=stage.decay
        )
        return {"optimizer": optimizer, "lr_scheduler": drops}


class LayoutStage(PaperStage):
    """The layout loss L_L of section 3.4 (Eq. 7), without shape decoding."""

    def training_step(self, views: SceneViews, batch_idx: int) -> Tensor:
        scenes = self.prior.decode(self.room_latents(views, batch_idx), with_shape=False)
        with full_precision(self.device):
            boxes = proxy_boxes(scenes, views, self.stage.proxy)
            losses, _ = match_and_score(scenes, boxes, views, self.loss, self.completeness_target)
            return self.total(losses, views, batch_idx)


class LiftedStage(PaperStage):
    """The layout loss against lifted 3D boxes, which no camera has to be asked for again; as the
    shape stage, with the distance to the lifted shapes."""

    @staticmethod
    def has_proxies(stage: Any) -> bool:
        return False

    def on_fit_start(self) -> None:
        # Only now, when a resumed run has its checkpoint's prototypes.
        if isinstance(self.stage, LiftedShapeConfig):
            assert isinstance(self.rooms, LiftedDataset)
            assert isinstance(self.prior.shape, OccupancyDecoder)
            self.rooms.see_looks(self.prior.shape.prototypes)

    def training_step(self, rooms: LiftedRooms, batch_idx: int) -> Tensor:
        slots = min(rooms.is_object.shape[1] + 1, self.prior.max_objects)
        wanted = needed_predictions(rooms, slots)
        scenes = self.prior.decode(self.room_latents(rooms, batch_idx), False, wanted)
        with full_precision(self.device):
            matches = match_lifted(scenes, rooms, self.loss.match_box)
            losses = lifted_losses(scenes, rooms, matches, self.completeness_target)
            if isinstance(self.stage, LiftedShapeConfig):
                assert isinstance(self.prior.shape, OccupancyDecoder) and rooms.looks is not None
                known = matches._replace(valid=matches.valid & (rooms.looks >= 0))
                targets = self.prior.shape.targets(rooms.looks.clamp(min=0))
                losses["mask"] = shape_code_loss(scenes, known, *targets)
            return self.total(losses, rooms, batch_idx)


class ShapeStage(PaperStage):
    """The layout loss, now of deformed meshes, plus the mask loss: L = L_L + lambda_S L_S."""

    stage: ShapeConfig

    @staticmethod
    def has_proxies(stage: Any) -> bool:
        return stage.box_from == "proxy"

    def training_step(self, views: SceneViews, batch_idx: int) -> Tensor:
        # Of n objects, only the first n predictions are drawn and matched.
        scenes = self.prior.decode(self.room_latents(views, batch_idx), views.is_object)
        with full_precision(self.device):
            boxes = seen_boxes(scenes, views, self.stage)
            losses, matches = match_and_score(
                scenes, boxes, views, self.loss, self.completeness_target
            )
            # Before rendering, too, which refuses vertices that are not finite and knows no rooms.
            check_finite(weighted_sum(losses, self.loss), views)
            faces = self.prior.faces
            assert scenes.vertices_m is not None and faces is not None, "masks are of meshes"
            masks = seen_masks(scenes.vertices_m, faces, views, self.stage)
            losses["mask"], overlap = mask_loss(masks, views, matches, self.loss.iou_gate)
            return self.total(losses, views, batch_idx, beside=overlap)

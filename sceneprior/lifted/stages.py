"""The stage that trains the paper's network and latents on lifted boxes and shapes."""

import torch
from torch import Tensor

from sceneprior.lifted.lifting.dataset import LiftedDataset, LiftedRooms
from sceneprior.lifted.losses import (
    LiftedLossConfig,
    latent_loss,
    lifted_losses,
    match_lifted,
    needed_predictions,
    shape_code_loss,
)
from sceneprior.lifted.prototype_decoder import PrototypeDecoder
from sceneprior.paper.stages import LatentStage
from sceneprior.training.steps import batch_seed, check_finite, full_precision


class LiftedStage(LatentStage):
    """Trains with the layout loss against lifted 3D boxes, and the distance to lifted shapes."""

    loss: LiftedLossConfig
    rooms: LiftedDataset
    """The training rooms, which `LiftedConfig` sets."""

    @property
    def looks(self) -> PrototypeDecoder:
        """The shape decoder."""
        assert isinstance(self.prior.shape, PrototypeDecoder)
        return self.prior.shape

    def on_fit_start(self) -> None:
        # Done only now, since a resumed run has just loaded its checkpoint's prototypes.
        self.rooms.assign_prototypes(self.looks.prototypes)

    def training_step(self, rooms: LiftedRooms, batch_idx: int) -> Tensor:
        slots = min(rooms.is_object.shape[1] + 1, self.prior.max_objects)
        wanted = needed_predictions(rooms, slots)
        scenes = self.prior.decode(self.room_latents(rooms.room_index, batch_idx), False, wanted)
        with full_precision(self.device):
            matches = match_lifted(scenes, rooms, self.loss.match_box)
            losses = lifted_losses(scenes, rooms, matches, self.completeness_target)
            assert rooms.looks is not None, "on_fit_start has found them"
            known = matches._replace(valid=matches.valid & (rooms.looks >= 0))
            targets = self.looks.targets(rooms.looks.clamp(min=0))
            losses["shape"] = shape_code_loss(scenes, known, *targets)
            if self.loss.latents:
                seed = batch_seed(self.seed, self.trainer, batch_idx) + 1  # not the noise's seed
                generator = torch.Generator().manual_seed(seed)
                space = self.prior.latent_space
                losses["latents"] = latent_loss(self.latents.weight, space.shift_free, generator)
            total = self.total(losses, len(rooms.room_index))
            check_finite(total, rooms.room_ids)
            return total

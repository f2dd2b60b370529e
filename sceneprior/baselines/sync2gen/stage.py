"""The Sync2Gen-style VAE with 3D supervision: its config and its training."""

from typing import Literal

import torch
from pydantic import Field
from torch import Tensor

from sceneprior.baselines.one_stage import OneStage, OneStageTraining
from sceneprior.baselines.sync2gen.network import Sync2Gen, Sync2genModel
from sceneprior.baselines.true_boxes import BoxConfig, room_means
from sceneprior.core.views import RoomBoxes
from sceneprior.training.steps import full_precision


class Sync2genTraining(OneStageTraining):
    """The released epochs, batch size and learning rate."""

    epochs: int = Field(800, ge=1)
    batch_size: int = Field(64, ge=1)
    learning_rate: float = Field(1e-3, gt=0)
    kl_weight: float = Field(0.1, ge=0)
    """Weight of the KL divergence from N(0, 1). A larger weight makes new rooms better but less
    varied; a smaller one reconstructs training rooms better, but makes new rooms worse."""


class Sync2genConfig(BoxConfig):
    """Config of a run of the Sync2Gen-style VAE."""

    method: Literal["sync2gen"] = "sync2gen"
    model: Sync2genModel = Sync2genModel()
    training: Sync2genTraining = Sync2genTraining()

    def make(self) -> "Sync2genStage":
        network = Sync2Gen(self.model, self.classes, self.seed)
        return Sync2genStage(network, self.training)


class Sync2genStage(OneStage):
    """Minimises reconstruction errors and the KL divergence of latents from N(0, 1)."""

    prior: Sync2Gen
    settings: Sync2genTraining

    def training_step(self, rooms: RoomBoxes, batch_idx: int) -> Tensor:
        matrix = self.prior.to_matrix(rooms)
        mean, log_variance = self.prior.encode(matrix)
        # `StepSeed` seeds this noise by the step, so that a resumed run draws the same.
        z = mean + torch.exp(0.5 * log_variance) * torch.randn_like(mean)
        decoded = self.prior.decode(z)
        with full_precision(self.device):
            decoded = decoded.float()
            losses = self.prior.losses(matrix, decoded, mean.float(), log_variance.float())
            self.prior.note_errors(matrix, decoded)
            objects = rooms.is_object.sum()
            left_out = (objects - matrix[..., 0].sum()) / objects.clamp(min=1)
            weights = {"kl": self.settings.kl_weight}
            return self.total(room_means(losses, rooms), weights, rooms, {"left_out": left_out})

"""Baseline with 3D supervision: the Sync2Gen-style VAE learns to give back whole arrangements."""

import lightning
import torch
from torch import Tensor

from sceneprior.baselines.box_training import build_box_optimizer, total_of_rooms
from sceneprior.baselines.sync2gen.network import Sync2Gen
from sceneprior.baselines.true_boxes import TruthDataset
from sceneprior.classes import label_set
from sceneprior.config import RunConfig
from sceneprior.training.objective import full_precision
from sceneprior.views import RoomBoxes


class Sync2genStage(lightning.LightningModule):
    """What a VAE minimises: how badly rooms are given back, and how far latents are from N(0, 1).

    Args:
        prior: The network, which knows the training rooms' statistics.
        config: The run.
    """

    def __init__(self, prior: Sync2Gen, config: RunConfig):
        super().__init__()
        self.prior = prior
        self.config = config

    def training_step(self, rooms: RoomBoxes, batch_idx: int) -> Tensor:
        matrix = self.prior.to_matrix(rooms)
        mean, log_variance = self.prior.encode(matrix)
        # `StepSeed` makes this step's noise its own, the same when a run is resumed.
        z = mean + torch.exp(0.5 * log_variance) * torch.randn_like(mean)
        decoded = self.prior.decode(z)
        with full_precision(self.device):
            decoded = decoded.float()
            losses = self.prior.losses(matrix, decoded, mean.float(), log_variance.float())
            self.prior.note_errors(matrix, decoded)
            objects = rooms.is_object.sum()
            return total_of_rooms(
                self,
                rooms,
                losses,
                weights={"kl": self.config.sync2gen.kl_weight},
                beside={"left_out": (objects - matrix[..., 0].sum()) / objects.clamp(min=1)},
            )

    def configure_optimizers(self):
        steps = int(self.trainer.estimated_stepping_batches)
        return build_box_optimizer(self.prior, self.config.sync2gen, steps)


def build_network(config: RunConfig) -> Sync2Gen:
    """The network a config describes, freshly initialised from its seed."""
    torch.manual_seed(config.seed)
    settings = config.sync2gen
    return Sync2Gen(
        classes=len(label_set(config.label_set)), slots=settings.slots, width=settings.width,
        latent=settings.latent, refine_steps=settings.refine_steps, seed=config.seed,
    )  # fmt: skip


def build(config: RunConfig, dataset: TruthDataset) -> Sync2genStage:
    """The stage at its start."""
    prior = build_network(config)
    prior.fit_statistics(dataset.everything(), config.seed)
    return Sync2genStage(prior, config)

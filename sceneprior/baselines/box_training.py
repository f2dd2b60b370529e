"""What the two stages that learn from true boxes share, as functions."""

import lightning
import torch
from jaxtyping import Float
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn

from sceneprior.config import BoxStageConfig
from sceneprior.losses.processes import share_of_batch
from sceneprior.training.objective import check_finite
from sceneprior.views import RoomBoxes


def total_of_rooms(
    stage: lightning.LightningModule,
    rooms: RoomBoxes,
    losses: dict[str, Float[Tensor, " rooms"]],
    weights: dict[str, float],
    beside: dict[str, Float[Tensor, ""]] | None = None,
) -> Float[Tensor, ""]:
    """Mean over rooms of the weighted sum of their terms; logged, term by term.

    Args:
        stage: Logs under `train/`.
        rooms: The batch; of several processes' batches, each room with an id counts the same.
        losses: Of each room, by name.
        weights: Of the terms; 1 where none is given.
        beside: Logged, too, but not minimised.

    Raises:
        FloatingPointError: the total is NaN or infinite; names the rooms.
    """
    count = len(rooms.room_ids)
    share = share_of_batch(torch.tensor(count, device=rooms.boxes_m.device))
    means = {name: share * loss.sum() / max(count, 1) for name, loss in losses.items()}
    total = torch.stack([weights.get(name, 1.0) * mean for name, mean in means.items()]).sum()
    check_finite(total, rooms)
    named = {f"train/{name}": v.detach() for name, v in (means | (beside or {})).items()}
    named["train/loss"] = total.detach()
    stage.log_dict(named, on_step=False, on_epoch=True, batch_size=max(count, 1), sync_dist=True)
    return total


def build_box_optimizer(
    network: nn.Module, settings: BoxStageConfig, steps: int
) -> torch.optim.Optimizer | OptimizerLRSchedulerConfig:
    """Adam with the stage's schedule over `steps` updates."""
    optimizer = torch.optim.Adam(network.parameters(), lr=settings.learning_rate)
    if settings.schedule == "constant":
        return optimizer
    rise = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, settings.learning_rate, total_steps=steps + 1, pct_start=0.05,
        cycle_momentum=False,
    )  # fmt: skip
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": rise, "interval": "step"}}

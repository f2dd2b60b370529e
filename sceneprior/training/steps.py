"""Parts of a training step that all methods share: weighted sum, checks, seeds, precision,
schedule."""

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch import distributed as dist

from sceneprior.core.settings import Section

if TYPE_CHECKING:  # importing Lightning takes longer than the rest of loading a prior
    import lightning.pytorch.utilities.types


def weighted_sum(
    losses: dict[str, Float[Tensor, "*rooms"]], weights: Section
) -> Float[Tensor, "*rooms"]:
    """The weighted sum of losses, one number or one per room: Eq. 7 with the layout losses.

        L = sum_t lambda_t L_t

    `weights` has a key lambda_t for each L_t.
    """
    by_name = weights.model_dump(by_alias=True)
    return torch.stack([by_name[name] * loss for name, loss in losses.items()]).sum(dim=0)


def check_finite(total: Tensor, room_ids: tuple[str, ...]) -> None:
    """Raise a `FloatingPointError` that names the batch's rooms if the total loss is not finite.

    All processes stop together: if one stopped alone, the others would wait for it.
    """
    value = total.item()
    finite = math.isfinite(value)
    told = [(value, () if finite else room_ids)]
    if dist.is_available() and dist.is_initialized():
        worst = torch.tensor(int(finite), device=total.device)
        dist.all_reduce(worst, dist.ReduceOp.MIN)
        finite = bool(worst)
        if not finite:
            told *= dist.get_world_size()
            dist.all_gather_object(told, told[0])
    if finite:
        return
    value = next((bad for bad, rooms in told if rooms), value)
    raise FloatingPointError(
        f"The loss is {value} on rooms {', '.join(room for _, rooms in told for room in rooms)}; "
        "lower the learning rate, or look at these rooms with `sceneprior inspect`."
    )


def full_precision(device: torch.device) -> torch.autocast:
    """Context that turns mixed precision off, for latents, projections, matching, silhouettes and
    losses. Only the networks may run in lower precision."""
    return torch.autocast(device.type, enabled=False)


def batch_seed(seed: int, trainer: "lightning.Trainer", batch_idx: int) -> int:
    """A distinct seed for each batch and process; a resumed run gets the same seeds."""
    batch = trainer.current_epoch * int(trainer.num_training_batches) + batch_idx
    sequence = np.random.SeedSequence([seed, batch, trainer.global_rank])
    return int(sequence.generate_state(1, np.uint64)[0] >> 1)


def log_losses(
    module: "lightning.LightningModule", values: dict[str, Tensor], total: Tensor, rooms: int
) -> None:
    """Log means over an epoch and all processes, as `train/<name>`, and `total` as `train/loss`."""
    named = {f"train/{name}": value.detach() for name, value in (values | {"loss": total}).items()}
    module.log_dict(named, on_step=False, on_epoch=True, batch_size=rooms, sync_dist=True)


def with_cosine(
    optimizer: torch.optim.Optimizer, steps: int
) -> "lightning.pytorch.utilities.types.OptimizerLRSchedulerConfig":
    """The optimiser with a schedule: learning rates rise during the first twentieth of `steps`, and
    then fall to 0 along a cosine."""
    rise = torch.optim.lr_scheduler.OneCycleLR(
        optimizer,
        [group["lr"] for group in optimizer.param_groups],
        total_steps=steps + 1,
        pct_start=0.05,
        cycle_momentum=False,
    )
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": rise, "interval": "step"}}

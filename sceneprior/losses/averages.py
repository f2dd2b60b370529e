"""Means over objects: of a batch that several processes share, or of each room alone."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch import distributed as dist


def mean_of_objects(
    values: Float[Tensor, "rooms objects"],
    counted: Bool[Tensor, "rooms objects"],
    per_room: bool = False,
) -> Float[Tensor, "*rooms"]:
    """Mean over the objects that count; 0 where none does.

    One over all objects of the batch, and of all processes; `per_room`, one a room, whatever else
    is in the batch: for rooms that are fitted each on its own.
    """
    weights = counted.to(values.dtype)
    if per_room:
        return (values * weights).sum(dim=1) / weights.sum(dim=1).clamp(min=1)
    count = weights.sum()
    return (values * weights).sum() / count.clamp(min=1) * share_of_batch(count)


def share_of_batch(count: Tensor) -> Float[Tensor, ""]:
    """What this process's mean over `count` things weighs in the mean over all processes' things.

        share = processes * count / (sum of all processes' counts)

    Processes (DDP) average their gradients. A mean of means is not the mean: an object in a rank
    with few of them would count for more. With each mean times its share, the averaged gradient
    is the one that a single process has on the whole batch. 1 where there is one process.

    Every process must call it, in the same order: it waits for the others.

    Example: alone, a mean is taken as it is.

        >>> share_of_batch(torch.tensor(7)).item()
        1.0
    """
    mine = count.detach().to(torch.float32)
    if not (dist.is_available() and dist.is_initialized()):
        return torch.ones_like(mine)
    total = mine.clone()
    dist.all_reduce(total)
    return dist.get_world_size() * mine / total.clamp(min=1)

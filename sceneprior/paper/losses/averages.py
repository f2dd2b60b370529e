"""Means over objects: over a batch that several processes share, or over each room alone."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch import distributed as dist


def mean_of_objects(
    values: Float[Tensor, "rooms objects"],
    counted: Bool[Tensor, "rooms objects"],
    per_room: bool = False,
) -> Float[Tensor, "*rooms"]:
    """Mean over the objects for which `counted` is true; 0 if there are none.

    By default, one mean is taken over all objects of the batch, in all processes. With `per_room`,
    one mean is taken per room, independent of the rest of the batch; it is for rooms that are
    fitted separately.
    """
    weights = counted.to(values.dtype)
    if per_room:
        return (values * weights).sum(dim=1) / weights.sum(dim=1).clamp(min=1)
    count = weights.sum()
    return (values * weights).sum() / count.clamp(min=1) * share_of_batch(count)


def share_of_batch(count: Tensor) -> Float[Tensor, ""]:
    """Weight of this process's mean over `count` items in the mean over the items of all processes.

        share = processes * count / (sum of all processes' counts)

    DDP averages the gradients of all processes, and a mean of means is not the overall mean: an
    object in a process with few objects would count more. If each process multiplies its mean by
    its share, the averaged gradient equals that of a single process on the whole batch. The share
    is 1 for one process.

    Every process must call this function, in the same order, because it waits for the others.
    """
    mine = count.detach().to(torch.float32)
    if not (dist.is_available() and dist.is_initialized()):
        return torch.ones_like(mine)
    total = mine.clone()
    dist.all_reduce(total)
    return dist.get_world_size() * mine / total.clamp(min=1)

"""Losses of a batch that several processes share: what each process's mean counts for."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch import distributed as dist


def share_of_batch(count: Tensor) -> Float[Tensor, ""]:
    """What this process's mean over `count` things weighs in the mean over all processes' things.

        share = processes * count / (sum of all processes' counts)

    Processes (DDP) average their gradients. A mean of means is not the mean: an object in a rank
    with few of them would count for more. With each mean times its share, the averaged gradient
    is the one that a single process has on the whole batch. 1 where there is one process.

    Every process must call it, in the same order: it waits for the others.

    Args:
        count: How many things the process's own mean is over; 0-dimensional.

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

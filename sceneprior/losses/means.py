"""What is averaged over objects: one mean for the batch, or one for each room."""

from jaxtyping import Bool, Float
from torch import Tensor

from sceneprior.losses.processes import share_of_batch


def mean_of_objects(
    values: Float[Tensor, "rooms objects"],
    counted: Bool[Tensor, "rooms objects"],
    per_room: bool = False,
) -> Float[Tensor, "*rooms"]:
    """Mean over the objects that count; 0 where none does.

    Args:
        values: One number an object.
        counted: Which objects count.
        per_room: One mean a room, whatever else is in the batch: for rooms that are fitted each
            on its own. Else one mean over all objects of the batch, and of all processes.
    """
    weights = counted.to(values.dtype)
    if per_room:
        return (values * weights).sum(dim=1) / weights.sum(dim=1).clamp(min=1)
    count = weights.sum()
    return (values * weights).sum() / count.clamp(min=1) * share_of_batch(count)

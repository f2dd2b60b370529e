"""Decoded boxes in, a penalty on those that share more room than their classes ever do out."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from sceneprior.batches import DecodedScenes


def shared_volume(
    centers_m: Float[Tensor, "rooms objects 3"], sizes_m: Float[Tensor, "rooms objects 3"]
) -> Float[Tensor, "rooms objects objects"]:
    """The volume in which two boxes intersect, as a share of the smaller one's."""
    low, high = centers_m - sizes_m / 2, centers_m + sizes_m / 2
    edges = torch.minimum(high.unsqueeze(2), high.unsqueeze(1)) - torch.maximum(
        low.unsqueeze(2), low.unsqueeze(1)
    )
    volume = sizes_m.prod(dim=-1)
    smaller = torch.minimum(volume.unsqueeze(2), volume.unsqueeze(1))
    return edges.clamp(min=0).prod(dim=-1) / smaller.clamp(min=1e-6)


class OverlapAllowance(nn.Module):
    """How much of the smaller box each pair of classes shares in decoded training rooms, at most.

    Args:
        classes: Size of the label set.
        decay: What is left of a maximum from one step to the next, so that it forgets how rooms
            were decoded when training began.
    """

    def __init__(self, classes: int, decay: float = 0.99):
        super().__init__()
        self.allowed: Tensor
        self.register_buffer("allowed", torch.zeros(classes, classes))
        self.decay = decay

    @torch.no_grad()
    def observe(self, scenes: DecodedScenes, kept: Bool[Tensor, "rooms objects"]) -> None:
        """Take in decoded training rooms."""
        shared, pair, rows, columns = _pairs(scenes, kept)
        seen = torch.zeros_like(self.allowed).flatten()
        size = self.allowed.shape[0]
        seen.scatter_reduce_(0, rows[pair] * size + columns[pair], shared[pair], "amax")
        seen = seen.reshape(size, size)
        self.allowed.copy_(torch.maximum(self.decay * self.allowed, torch.maximum(seen, seen.T)))

    def forward(
        self, scenes: DecodedScenes, kept: Bool[Tensor, "rooms objects"]
    ) -> Float[Tensor, ""]:
        """Share beyond the allowance, summed over a room's pairs, averaged over rooms."""
        shared, pair, rows, columns = _pairs(scenes, kept)
        beyond = (shared - self.allowed[rows, columns]).clamp(min=0)
        return (beyond * pair).sum() / len(shared)


def _pairs(scenes: DecodedScenes, kept: Bool[Tensor, "rooms objects"]):
    shared = shared_volume(scenes.centers_m, scenes.sizes_m)
    label = scenes.class_logits.argmax(dim=-1)
    pair = (kept.unsqueeze(2) & kept.unsqueeze(1)).triu(diagonal=1)
    rows, columns = torch.broadcast_tensors(label.unsqueeze(2), label.unsqueeze(1))
    return shared, pair, rows, columns

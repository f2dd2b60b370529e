"""Completeness scores: their targets, and the predictions that they keep (section 3.4).

The two conventions, for a room of n objects:

- `first_n` (supplement B): 1 for the first n predictions, 0 after. A generated scene ends
  before its first prediction whose score is not above 0.5.
- `stop` (released code): 1 from the n-th prediction on. A generated scene ends with its first
  prediction whose score is above 0.5; it is never empty.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def completeness_targets(
    counts: Int[Tensor, " rooms"], slots: int, convention: str = "first_n"
) -> Bool[Tensor, "rooms slots"]:
    """Target scores of `slots` predictions, in rooms of `counts` objects."""
    position = torch.arange(slots, device=counts.device)
    if convention == "stop":
        return position >= counts.unsqueeze(-1) - 1
    return position < counts.unsqueeze(-1)


def kept_objects(
    logits: Float[Tensor, "rooms slots"], convention: str = "first_n"
) -> Bool[Tensor, "rooms slots"]:
    """Mask of the predictions that belong to the scene; a logit above 0 is a score above 0.5."""
    says_yes = (logits > 0).long()
    if convention == "stop":
        return says_yes.cumsum(dim=-1) - says_yes == 0  # no earlier prediction said stop
    return says_yes.cumprod(dim=-1).bool()

"""Completeness scores: their targets, and which predictions they keep (section 3.4).

The two conventions, for a room of n objects:

- `first_n` (supplement B): ones for the first n predictions, zeros after. A generated scene ends
  before its first object whose score is not above 0.5.
- `stop` (released code): ones from the last real object on. A generated scene ends with its first
  object whose score is above 0.5; it is never empty.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def completeness_targets(
    counts: Int[Tensor, " rooms"], slots: int, convention: str = "first_n"
) -> Bool[Tensor, "rooms slots"]:
    """What the scores of `slots` predictions should be in rooms of `counts` objects."""
    position = torch.arange(slots, device=counts.device)
    if convention == "stop":
        return position >= counts.unsqueeze(-1) - 1
    return position < counts.unsqueeze(-1)


def kept_objects(
    logits: Float[Tensor, "rooms slots"], convention: str = "first_n"
) -> Bool[Tensor, "rooms slots"]:
    """Which predictions belong to the scene; a logit above 0 is a score above 0.5."""
    says_yes = (logits > 0).long()
    if convention == "stop":
        return says_yes.cumsum(dim=-1) - says_yes == 0  # none before it said stop
    return says_yes.cumprod(dim=-1).bool()


def kept_share(
    scores: Float[Tensor, "rooms slots"], convention: str = "first_n"
) -> Float[Tensor, "rooms slots"]:
    """How likely each prediction belongs to the scene, if each score is the chance of a yes.

    Of scores that are 0 or 1 these are the `kept_objects`, and the gradient of each score is what
    its change would bring about: the end of the scene there, or some objects more.
    """
    if convention == "stop":
        none_before = torch.cat([torch.ones_like(scores[:, :1]), 1 - scores[:, :-1]], dim=1)
        return none_before.cumprod(dim=1)
    return scores.cumprod(dim=1)

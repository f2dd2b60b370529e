"""Learnt bevels of each class, for the proxy `beveled_box`."""

import torch
from jaxtyping import Float
from torch import Tensor, nn


class ClassBevels(nn.Module):
    """How far the edges of a class's boxes are cut off, in [0, 1]; see `beveled_cube`.

    Furniture fills its box neither as an ellipsoid does nor to the corners, so the 2D box of
    either misleads about its size. Chairs and round tables have much of their edges missing,
    wardrobes nothing: what a class has, the views of all its objects tell.

    Args:
        classes: Size of the label set.
    """

    def __init__(self, classes: int):
        super().__init__()
        # Nearly a box: 0.12 of half a side.
        self.logits = nn.Parameter(torch.full((classes, 2), -2.0))

    def forward(
        self, class_logits: Float[Tensor, "rooms objects classes"]
    ) -> Float[Tensor, "rooms objects 2"]:
        """Bevels of upright and level edges: the mean over predicted classes, which learn nothing
        from it."""
        return class_logits.detach().softmax(dim=-1) @ self.logits.sigmoid()

"""Relations of the next object's look to the looks of the objects already placed."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.core.geometry.turns import QUARTERS
from sceneprior.core.views import RoomBoxes
from sceneprior.lifted.prototypes import POSES
from sceneprior.lifted.sampler.frames import side_of

RELATIONS = 5
"""Number of features of the relation of a direction to an object already placed: its back points
in the same direction, in the opposite one, or sideways; the logarithm of the ratio of its extents,
along the direction to across it; and the absolute value of this logarithm."""
MOST_LOG = 1.0
"""Bound of this logarithm."""


class Relatives(nn.Module):
    """Scores of the next object's look, given the looks of the objects already placed.

    Chairs at a table point in the same direction or in opposite ones, towards its long sides, and
    they have the same shape. The encoder learns neither from a few hundred rooms: it encodes a look
    by a coarse grid of its shape, in which it recognises neither the back nor the same prototype.

    Args:
        classes: Size of the label set.
    """

    def __init__(self, classes: int):
        super().__init__()
        self.direction_table = nn.Parameter(torch.zeros(classes, classes, RELATIONS))
        self.repeat_table = nn.Parameter(torch.zeros(classes))

    def forward(
        self,
        label: Int[Tensor, " rooms"],
        before: RoomBoxes,
        backs: Int[Tensor, " prototypes"],
        looks: int,
    ) -> Float[Tensor, "rooms looks"]:
        """The sum of two scores of each look of an object of class `label`: that of the direction
        of its back, and that of a prototype that another object of its class has.

        Args:
            backs: Side of every prototype's back; see `side_of`.
            looks: Number of looks.
        """
        assert before.looks is not None
        sides = side_of(torch.arange(looks, device=label.device), backs)
        same_class = before.is_object & (before.object_class == label.unsqueeze(1))
        prototypes = F.one_hot(before.looks // POSES, looks // POSES) * same_class.unsqueeze(-1)
        repeated = prototypes.sum(dim=1).clamp(max=1).repeat_interleave(POSES, dim=1)
        return (
            self.directions(label, before, backs)[:, sides]
            + repeated * self.repeat_table[label].unsqueeze(1)
        )

    def directions(
        self, label: Int[Tensor, " rooms"], before: RoomBoxes, backs: Int[Tensor, " prototypes"]
    ) -> Float[Tensor, "rooms 4"]:
        """Scores of the directions of the object's back, low z, low x, high z and high x: sums over
        the objects already placed, with coefficients for each pair of classes."""
        assert before.looks is not None
        sides = torch.arange(QUARTERS, device=label.device)
        turned = (side_of(before.looks, backs).unsqueeze(-1) - sides) % QUARTERS
        extents = before.boxes_m[..., [3, 5]].where(before.is_object.unsqueeze(-1), 1.0)
        along_x = (extents[..., :1].log() - extents[..., 1:].log()).clamp(-MOST_LOG, MOST_LOG)
        along = torch.where(sides % 2 == 1, along_x, -along_x)
        features = torch.stack([turned == 0, turned == 2, turned % 2 == 1, along, along.abs()], -1)
        table = self.direction_table[label.unsqueeze(1), before.object_class]
        table = table * before.is_object.unsqueeze(-1)
        return torch.einsum("rosf,rof->rs", features.to(table), table)

"""The layout decoder: class, box and completeness of each object (section 3.3, Eq. 5); bevels."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.classes import VOID
from sceneprior.models.layers import mlp
from sceneprior.models.released import SeparateHeads

INITIAL_SIZE_M = 0.7
"""Edge of every box before training."""


class Layout(NamedTuple):
    """Class l_k, centre c_k, size s_k and completeness p_k of each object; metres, room frame."""

    class_logits: Float[Tensor, "rooms objects classes"]
    centers_m: Float[Tensor, "rooms objects 3"]
    sizes_m: Float[Tensor, "rooms objects 3"]
    completeness_logits: Float[Tensor, "rooms objects"]


class JointHead(nn.Sequential):
    """MLP2: class logits, x, y, z, width, height, depth and completeness from one MLP."""

    def __init__(self, hidden: int, classes: int):
        super().__init__(
            nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, classes + 7)
        )

    def rows(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and bias of each output in the last layer, in the outputs' order."""
        last: nn.Linear = self[-1]  # type: ignore[assignment]
        return list(zip(last.weight, last.bias, strict=True))


class LayoutDecoder(nn.Module):
    """MLP1 (shared with the shape decoder), then MLP2 (Eq. 5).

        {l_k, c_k, s_k, p_k} = MLP2(MLP1(x_k))

    `heads` are `joint` (paper) or `separate` (`SeparateHeads`); `void` lets an object be `void`, a
    second way not to exist beside completeness; `floor_gradient` as in `ModelConfig`.
    """

    def __init__(
        self,
        width: int,
        classes: int,
        heads: str = "joint",
        void: bool = True,
        floor_gradient: bool = False,
    ):
        super().__init__()
        hidden = 2 * width
        self.floor_gradient = floor_gradient
        self.classes, self.void = classes, void
        self.mlp1 = mlp(nn.Linear(width, width), nn.Linear(width, hidden))
        self.mlp2 = (
            SeparateHeads(hidden, classes) if heads == "separate" else JointHead(hidden, classes)
        )
        # Section 3.4: every object starts at the floor centre. Weights are small rather than
        # zero, so that objects can part; y starts a little above 0, where ReLU has a slope.
        size = float(torch.log(torch.expm1(torch.tensor(INITIAL_SIZE_M, device="cpu"))))
        starts = (0.0, 0.1, 0.0, size, size, size, 0.0)
        with torch.no_grad():
            for (weight, bias), start in zip(self.mlp2.rows()[-7:], starts, strict=True):
                weight *= 0.1
                bias.fill_(start)

    def forward(
        self, features: Float[Tensor, "rooms objects width"]
    ) -> tuple[Layout, Float[Tensor, "rooms objects hidden"]]:
        """The layout, and MLP1's output, from which the shape decoder goes on.

        Sizes pass a SoftPlus; the box's lower side is ReLU(y), so c'_y = ReLU(y) + s_y / 2
        and no object reaches below the floor (supplement A, Eq. S1).
        """
        shared = self.mlp1(features)
        out = self.mlp2(shared)
        logits, center, size, complete = out.split([self.classes, 3, 3, 1], dim=-1)
        if not self.void:
            is_void = torch.arange(self.classes, device=logits.device) == VOID
            logits = logits.masked_fill(is_void, -torch.inf)
        sizes = F.softplus(size)
        x, y, z = center.unbind(-1)
        bottom = above_floor(y) if self.floor_gradient else F.relu(y)
        y = bottom + sizes[..., 1] / 2
        centers = torch.stack([x, y, z], dim=-1)
        return Layout(logits, centers, sizes, complete[..., 0]), shared


class _AboveFloor(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, y: Tensor) -> Tensor:
        ctx.save_for_backward(y)
        return y.relu()

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        # Descent goes against the gradient: a negative one lifts.
        return upstream[0].where((y > 0) | (upstream[0] < 0), 0.0)


def above_floor(y: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """ReLU(y) whose gradient, where y is not above 0, is kept if descent would raise y with it.

    What ReLU has once put on the floor stays there: most furniture stands on it, and takes lamps
    along before the network can tell them apart.
    """
    lifted: Tensor = _AboveFloor.apply(y)
    return lifted


class ClassBevels(nn.Module):
    """How far the edges of a class's boxes are cut off, in [0, 1]; see `beveled_cube`.

    Furniture fills its box neither as an ellipsoid does nor to the corners, so the 2D box of
    either misleads about its size. Chairs and round tables have much of their edges missing,
    wardrobes nothing: what a class has, the views of all its objects tell.
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

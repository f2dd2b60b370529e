"""The layout decoder: class, box and completeness of each object (section 3.3, Eq. 5), and
bevels."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.core.classes import VOID
from sceneprior.paper.layers import mlp

INITIAL_SIZE_M = 0.7
"""Edge of every box before training."""


class Layout(NamedTuple):
    """Class l_k, centre c_k, size s_k and completeness p_k of each object; metres, room frame."""

    class_logits: Float[Tensor, "rooms objects classes"]
    centers_m: Float[Tensor, "rooms objects 3"]
    sizes_m: Float[Tensor, "rooms objects 3"]
    completeness_logits: Float[Tensor, "rooms objects"]


class JointHead(nn.Sequential):
    """MLP2 of Eq. 5: one MLP for class logits, x, y, z, width, height, depth and completeness."""

    def __init__(self, hidden: int, classes: int):
        super().__init__(
            nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, classes + 7)
        )

    def rows(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and bias of each output of the last layer, in the order of the outputs."""
        last: nn.Linear = self[-1]  # type: ignore[assignment]
        return list(zip(last.weight, last.bias, strict=True))


class SeparateHeads(nn.Module):
    """Replacement of MLP2: a linear layer for the classes and a separate MLP for each coordinate.

    `hidden` is the size of MLP1's output and of each coordinate's hidden layer.
    """

    def __init__(self, hidden: int, classes: int):
        super().__init__()
        self.classes = nn.Linear(hidden, classes)
        self.coordinates = nn.ModuleList(
            mlp(nn.Linear(hidden, hidden), nn.Linear(hidden, 1))
            for _ in ("x", "y", "z", "width", "height", "depth")
        )
        self.completeness = nn.Linear(hidden, 1)

    def forward(
        self, shared: Float[Tensor, "rooms objects hidden"]
    ) -> Float[Tensor, "rooms objects outputs"]:
        """Class logits, x, y, z, width, height, depth and completeness, in the order of
        `JointHead`."""
        x = F.relu(shared)
        parts = [self.classes(x), *(head(x) for head in self.coordinates), self.completeness(x)]
        return torch.cat(parts, dim=-1)

    def rows(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and bias of each output of the last layers, in the order of the outputs."""
        coordinates = (head[-1] for head in self.coordinates)  # type: ignore[index]
        last = (self.classes, *coordinates, self.completeness)
        return [row for layer in last for row in zip(layer.weight, layer.bias, strict=True)]


class LayoutDecoder(nn.Module):
    """MLP1 (shared with the shape decoder), then MLP2 (Eq. 5).

        {l_k, c_k, s_k, p_k} = MLP2(MLP1(x_k))

    `heads` is `joint` (paper) or `separate` (`SeparateHeads`). If `void` is true, predictions may
    have the class `void`, which leaves them out of the scene, as low completeness does.
    `floor_gradient` is explained in `ModelConfig`.
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
        # Section 3.4: every object starts at the floor centre. The weights are small rather than
        # zero, so that objects can separate; y starts slightly above 0, where ReLU has a gradient.
        size = float(torch.log(torch.expm1(torch.tensor(INITIAL_SIZE_M, device="cpu"))))
        starts = (0.0, 0.1, 0.0, size, size, size, 0.0)
        with torch.no_grad():
            for (weight, bias), start in zip(self.mlp2.rows()[-7:], starts, strict=True):
                weight *= 0.1
                bias.fill_(start)

    def forward(
        self, features: Float[Tensor, "rooms objects width"]
    ) -> tuple[Layout, Float[Tensor, "rooms objects hidden"]]:
        """The layout, and MLP1's output, which the shape decoder takes as input.

            c'_y = ReLU(y) + s_y / 2                                (Eq. S1)

        y is MLP2's output, so ReLU(y) is the height of the box's lower side, and no object reaches
        below the floor (supplement A). Sizes s_k are SoftPlus of MLP2's output.
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
        # Descent moves against the gradient: where it is negative, y rises.
        return upstream[0].where((y > 0) | (upstream[0] < 0), 0.0)


def above_floor(y: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """ReLU(y) whose gradient at y <= 0 is kept where a descent step would raise y, and 0 elsewhere.

    With a plain ReLU, an object that has reached the floor cannot leave it. Early in training, the
    network cannot yet distinguish lamps from other furniture, most of which stands on the floor, so
    it moves lamps down as well.
    """
    lifted: Tensor = _AboveFloor.apply(y)
    return lifted


class ClassBevels(nn.Module):
    """Fraction, in [0, 1], by which the box edges of each class are cut off; see `beveled_cube`.

    Furniture fills its box less than a cuboid and more than an ellipsoid does, so the 2D box of
    either solid would bias the predicted size. Chairs and round tables leave the edges of their box
    empty, wardrobes do not; the bevels of a class are learnt from all views of its objects.
    """

    def __init__(self, classes: int):
        super().__init__()
        # Initially nearly a box: 0.12 of half a side is cut off.
        self.logits = nn.Parameter(torch.full((classes, 2), -2.0))

    def forward(
        self, class_logits: Float[Tensor, "rooms objects classes"]
    ) -> Float[Tensor, "rooms objects 2"]:
        """Bevels of vertical and horizontal edges: the mean of the classes' bevels, weighted by the
        class probabilities, which get no gradient here."""
        return class_logits.detach().softmax(dim=-1) @ self.logits.sigmoid()

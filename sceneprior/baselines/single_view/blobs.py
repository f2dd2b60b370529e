"""Im3D's shapes: sums of Gaussians in the box's frame (structured implicit functions).

    f(x) = sum_k w_k exp(-|(x - p_k) / r_k|^2 / 2),    inside where f > LEVEL

The box is [-1, 1]^3 and its axes are those of the image's frame. A Gaussian is seven numbers: its
centre p_k (3), and the logs of its radii r_k (3) and of its weight w_k.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.baselines.single_view.detections import Detections
from sceneprior.baselines.single_view.network import Placed, last_layer
from sceneprior.baselines.single_view.total3d import TrueObjects, mean_of_masks
from sceneprior.baselines.single_view.truth import CELLS
from sceneprior.core.geometry.turns import turn_vectors

STEEP, LEVEL = 10.0, 0.5
"""The occupancy logit of a point is STEEP (f - LEVEL)."""


class Blobs(nn.Module):
    """The Gaussians of each mask's shape, from its features."""

    start: Tensor

    def __init__(self, width: int, count: int):
        super().__init__()
        self.layer = last_layer(width, 7 * count)
        spread = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
        self.register_buffer("start", 1.6 * spread - 0.8)

    def forward(self, features: Float[Tensor, "masks width"]) -> Float[Tensor, "masks blobs 7"]:
        """Seven numbers for each Gaussian. Before training, centres are about `start`."""
        blobs = self.layer(features).float().unflatten(-1, (-1, 7))
        centers, log_radii, log_weights = blobs.split([3, 3, 1], dim=-1)
        centers = (self.start + centers).clamp(-1.2, 1.2)
        return torch.cat([centers, log_radii - 1.0, log_weights - 0.7], dim=-1)


def occupancy_logits(
    blobs: Float[Tensor, "*batch blobs 7"], points: Float[Tensor, "*batch points 3"]
) -> Float[Tensor, "*batch points"]:
    """Logits of points being inside, positive where they are."""
    centers, log_radii, log_weights = blobs.split([3, 3, 1], dim=-1)
    # |(x - p) / r|^2 as matrix products, without a tensor of masks x points x blobs x 3.
    inverse = torch.exp(-2 * log_radii)
    squares = points**2 @ inverse.transpose(-1, -2)
    squares = squares - 2 * points @ (centers * inverse).transpose(-1, -2)
    squares = squares + (centers**2 * inverse).sum(dim=-1).unsqueeze(-2)
    gaussians = torch.exp(log_weights[..., 0].unsqueeze(-2) - squares.clamp(min=0) / 2)
    return STEEP * (gaussians.sum(dim=-1) - LEVEL)


def cell_centers(cells: int) -> Float[Tensor, "points 3"]:
    """Centres of the cells of a grid that fills [-1, 1]^3; the last axis changes fastest."""
    along = (torch.arange(cells) + 0.5) / cells * 2 - 1
    return torch.cartesian_prod(along, along, along)


def occupancy_loss(
    found: Detections, blobs: Float[Tensor, "masks blobs 7"], true: TrueObjects, count: int
) -> Float[Tensor, ""]:
    """Binary cross entropy of `count` random cells of each true box."""
    cells = torch.randint(CELLS**3, (len(found), count), device=blobs.device)
    inside = true.occupied.flatten(1).gather(1, cells).to(blobs)
    logits = occupancy_logits(blobs, found.to_frame(cell_centers(CELLS).to(blobs)[cells]))
    return mean_of_masks(F.binary_cross_entropy_with_logits(logits, inside, reduction="none"))


def overlap_loss(
    found: Detections, placed: Placed, blobs: Float[Tensor, "masks blobs 7"]
) -> Float[Tensor, ""]:
    """Depth of objects inside each other, which moves boxes apart.

    It is the mean of max(0, 2 sigmoid(logit) - 1) over ordered pairs of an image's objects and over
    the Gaussians of the first, with the logit of the Gaussian's centre in the second object.
    Centres outside their own object do not count.
    """
    own = occupancy_logits(blobs, blobs[..., :3]) > 0
    centers_m = placed.points_m(found, blobs[..., :3])
    together = found.image.unsqueeze(0) == found.image.unsqueeze(1)
    one, other = together.fill_diagonal_(False).nonzero(as_tuple=True)
    away_m = centers_m[one] - placed.centers_m[other].unsqueeze(1)
    unit = away_m / (placed.sizes_m[other].unsqueeze(1) / 2).clamp(min=1e-3)
    logits = occupancy_logits(blobs[other], turn_vectors(unit, found.quarter[other]))
    return mean_of_masks((2 * logits.sigmoid() - 1).clamp(min=0) * own[one])

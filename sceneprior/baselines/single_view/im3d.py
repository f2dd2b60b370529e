"""The baseline Im3D: Total3D's boxes, refined over a graph of the scene, and implicit shapes.

After Zhang et al., "Holistic 3D Scene Understanding from a Single Image with Implicit Scene
Representation", CVPR 2021; docs/baselines_single_view.md names the differences.

Shapes are sums of Gaussians in the box's frame (structured implicit functions):

    f(x) = sum_k w_k exp(-|(x - p_k) / r_k|^2 / 2),    inside where f > LEVEL

The box is [-1, 1]^3 and its axes are those of the image's frame. A Gaussian is seven numbers: its
centre p_k (3), and the logs of its radii r_k (3) and of its weight w_k.
"""

from collections.abc import Iterator
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.baselines.one_stage import OneStage
from sceneprior.baselines.single_view.detections import (
    Detections,
    Placed,
    ViewNetwork,
    as_numpy,
    detections_of,
    last_layer,
)
from sceneprior.baselines.single_view.detector import (
    CELLS,
    GEOMETRY,
    CameraBoxes,
    Detector,
    DetectorConfig,
    DetectorModel,
    DetectorTraining,
    Estimate,
    TrueViews,
    corner_loss,
    estimate_losses,
    mean_of_masks,
    pair_geometry,
    presence,
    smooth_l1,
    true_objects,
)
from sceneprior.core.boxes import turn_vectors
from sceneprior.core.scene import Mesh
from sceneprior.core.surfaces import surface_of
from sceneprior.paper.decoders import mlp
from sceneprior.training.steps import full_precision

STEEP, LEVEL = 10.0, 0.5
"""The occupancy logit of a point is STEEP (f - LEVEL)."""
FINE = 32
"""Cells along each side of the grid from which a mesh is extracted."""


class Im3dModel(DetectorModel):
    """Size of the network."""

    rounds: int = Field(3, ge=1)
    """Rounds of message passing over the graph."""
    blobs: int = Field(32, ge=1)
    """Gaussians in a shape."""


class Im3dTraining(DetectorTraining):
    """Settings of the training. Box losses apply to the boxes before and after refinement."""

    shape: float = Field(1.0, ge=0)
    """Weight of the occupancy of points in the true boxes."""
    overlap: float = Field(0.1, ge=0)
    """Weight of `overlap_loss`, which keeps the objects of an image apart."""
    points: int = Field(128, ge=1)
    """Number of cells of each true box whose occupancy is compared in a step."""


class Im3dConfig(DetectorConfig):
    """Config of a run of Im3D."""

    method: Literal["im3d"] = "im3d"
    model: Im3dModel = Im3dModel()
    training: Im3dTraining = Im3dTraining()

    def make(self) -> "Im3dStage":
        return Im3dStage(Im3d(self.model, self.classes), self)


class SceneGraph(nn.Module):
    """Refines boxes by messages between an image's masks, which are the nodes. Every ordered pair
    of nodes is an edge; each round updates all edges, then all nodes."""

    def __init__(self, width: int, rounds: int):
        super().__init__()
        self.rounds = rounds
        self.node = nn.Linear(width + 6, width)
        self.edge = nn.Linear(GEOMETRY + 6, width // 2)
        self.renew_edge = mlp(
            nn.Linear(2 * width + width // 2, width), nn.Linear(width, width // 2)
        )
        self.message = nn.Linear(width // 2, width)
        self.renew_node = nn.GRUCell(width, width)
        self.change = last_layer(width, 6)

    def forward(
        self, found: Detections, features: Float[Tensor, "masks width"], start: CameraBoxes
    ) -> tuple[Float[Tensor, "masks width"], CameraBoxes]:
        """Features of the nodes after the last round, and the refined boxes."""
        placed = start.in_room(found)
        away = found.to_frame(placed.centers_m - found.eye_m)
        box = torch.cat([away, found.to_frame(placed.sizes_m).abs().log()], dim=-1)
        nodes = self.node(torch.cat([features, box], dim=-1)).relu()
        if len(found):
            nodes = self._exchange(found, nodes, box)
        offsets, log_distances, log_sizes = self.change(nodes).float().split([2, 1, 3], dim=-1)
        return nodes, CameraBoxes(
            start.offsets + offsets,
            start.log_distances + log_distances[:, 0],
            start.log_sizes + log_sizes,
        )

    def _exchange(
        self, found: Detections, nodes: Float[Tensor, "masks width"], box: Float[Tensor, "masks 6"]
    ) -> Float[Tensor, "masks width"]:
        present, boxes = presence(found), found.padded(box)
        pairs = (present.unsqueeze(1) & present.unsqueeze(2)).unsqueeze(-1)
        apart = boxes.unsqueeze(1) - boxes.unsqueeze(2)
        edges = self.edge(torch.cat([pair_geometry(found), apart], dim=-1)).relu()
        for _ in range(self.rounds):
            padded = found.padded(nodes)
            receivers = padded.unsqueeze(2).expand(-1, -1, padded.shape[1], -1)
            senders = padded.unsqueeze(1).expand(-1, padded.shape[1], -1, -1)
            edges = edges + self.renew_edge(torch.cat([receivers, senders, edges], dim=-1))
            messages = (self.message(edges.relu()) * pairs).sum(dim=2)
            messages = messages / pairs.sum(dim=2).clamp(min=1)
            nodes = self.renew_node(messages[found.image, found.slot], nodes)
        return nodes


class Blobs(nn.Module):
    """Predicts the Gaussians of each mask's shape from the mask's features."""

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
    """Occupancy logits of points, positive inside the shape."""
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


class Im3d(ViewNetwork):
    """Detects boxes, refines them over the graph, and predicts shapes from the graph's nodes."""

    def __init__(self, config: Im3dModel, classes: int):
        super().__init__()
        self.detector = Detector(config, classes)
        self.graph = SceneGraph(config.width, config.rounds)
        self.blobs = Blobs(config.width, config.blobs)

    def forward(
        self, found: Detections
    ) -> tuple[Estimate, CameraBoxes, Float[Tensor, "masks blobs 7"]]:
        """The detector's output, the refined boxes, and the shapes."""
        features, estimate = self.detector(found)
        # The graph refines the most likely boxes; no gradient flows back through them.
        start = CameraBoxes(*(part.detach() for part in estimate.boxes()))
        features, refined = self.graph(found, features, start)
        return estimate, refined, self.blobs(features)

    def reconstruct(self, found: Detections) -> tuple[Placed, Iterator[Mesh]]:
        _, refined, blobs = self(found)
        placed = refined.in_room(found)
        points = found.to_frame(cell_centers(FINE).to(blobs).expand(len(found), -1, -1))
        logits = as_numpy(occupancy_logits(blobs, points)).reshape(-1, FINE, FINE, FINE)
        boxes = zip(logits, *map(as_numpy, placed), strict=True)
        return placed, (Mesh(*surface_of(*box)) for box in boxes)


class Im3dStage(OneStage):
    """Learns the true boxes and occupied cells of the masked objects in all sampled views."""

    prior: Im3d
    settings: Im3dTraining

    def training_step(self, batch: TrueViews, batch_idx: int) -> Tensor:
        found = detections_of(batch.views)
        estimate, refined, blobs = self.prior(found)
        with full_precision(self.device):
            true = true_objects(found, batch)
            losses = estimate_losses(found, estimate, true)
            losses["refined_corners"] = corner_loss(found, refined, true)
            losses["refined"] = (
                smooth_l1(refined.offsets, true.boxes.offsets, true.ahead)
                + smooth_l1(refined.log_sizes, true.boxes.log_sizes)
                + smooth_l1(refined.log_distances, true.boxes.log_distances)
            )
            # The occupancy of random cells of each true box.
            cells = torch.randint(CELLS**3, (len(found), self.settings.points), device=blobs.device)
            inside = true.occupied.flatten(1).gather(1, cells).to(blobs)
            logits = occupancy_logits(blobs, found.to_frame(cell_centers(CELLS).to(blobs)[cells]))
            each = F.binary_cross_entropy_with_logits(logits, inside, reduction="none")
            losses["shape"] = mean_of_masks(each)
            losses["overlap"] = overlap_loss(found, refined.in_room(found), blobs.detach())
            return self.total(losses, batch.views)


def overlap_loss(
    found: Detections, placed: Placed, blobs: Float[Tensor, "masks blobs 7"]
) -> Float[Tensor, ""]:
    """Penalty on objects that intersect, which moves their boxes apart.

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

"""The baseline Im3D: Total3D's boxes, refined over a graph of the scene, and implicit shapes.

After Zhang et al., "Holistic 3D Scene Understanding from a Single Image with Implicit Scene
Representation", CVPR 2021; docs/baselines_single_view.md names the differences.
"""

from collections.abc import Iterator
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from sceneprior.baselines.one_stage import OneStage
from sceneprior.baselines.single_view.blobs import (
    Blobs,
    cell_centers,
    occupancy_logits,
    occupancy_loss,
    overlap_loss,
)
from sceneprior.baselines.single_view.detections import Detections, detections_of
from sceneprior.baselines.single_view.network import Placed, ViewNetwork, as_numpy, last_layer
from sceneprior.baselines.single_view.total3d import (
    GEOMETRY,
    CameraBoxes,
    Detector,
    DetectorConfig,
    DetectorModel,
    DetectorTraining,
    Estimate,
    corner_loss,
    estimate_losses,
    pair_geometry,
    presence,
    smooth_l1,
    true_objects,
)
from sceneprior.baselines.single_view.truth import TrueViews
from sceneprior.core.geometry.isosurface import surface_of
from sceneprior.core.scene import Mesh
from sceneprior.paper.layers import mlp
from sceneprior.training.steps import full_precision

FINE = 32
"""Cells along each side of the grid that a mesh is taken from."""


class Im3dModel(DetectorModel):
    """Size of the network."""

    rounds: int = Field(3, ge=1)
    """Rounds of messages over the graph."""
    blobs: int = Field(32, ge=1)
    """Gaussians in a shape."""


class Im3dTraining(DetectorTraining):
    """Settings of the training. Box losses count before and after refinement."""

    shape: float = Field(1.0, ge=0)
    """Weight of the occupancy of points in the true boxes."""
    overlap: float = Field(0.1, ge=0)
    """Weight of the depth of an image's objects inside each other."""
    points: int = Field(128, ge=1)
    """Cells of each true box that a step compares."""


class Im3dConfig(DetectorConfig):
    """A run of Im3D."""

    method: Literal["im3d"] = "im3d"
    model: Im3dModel = Im3dModel()
    training: Im3dTraining = Im3dTraining()

    def make(self) -> "Im3dStage":
        return Im3dStage(Im3d(self.model, self.classes), self.training)


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
        """The nodes after the last round, and the refined boxes."""
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


class Im3d(ViewNetwork):
    """The detector, the graph, and the shape of each object from the graph's nodes."""

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
        # The graph refines the likeliest boxes and sends no gradient back through them.
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
    """Learns the true boxes and occupied cells behind the masks of all views drawn."""

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
            losses["shape"] = occupancy_loss(found, blobs, true, self.settings.points)
            losses["overlap"] = overlap_loss(found, refined.in_room(found), blobs.detach())
            return self.total(losses, self.settings.weights(losses), batch.views)

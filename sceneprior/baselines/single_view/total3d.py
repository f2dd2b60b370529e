"""The baseline Total3D: boxes and meshes from single images, learnt from true boxes and meshes.

After Nie et al., "Total3DUnderstanding", CVPR 2020; docs/baselines_single_view.md names the
differences.
"""

from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from sceneprior.baselines.one_stage import OneStage
from sceneprior.baselines.single_view.detections import (
    Detections,
    Placed,
    ViewNetwork,
    as_numpy,
    detections_of,
)
from sceneprior.baselines.single_view.detector import (
    Detector,
    DetectorConfig,
    DetectorModel,
    DetectorTraining,
    Estimate,
    TrueViews,
    estimate_losses,
    mean_of_masks,
    true_objects,
)
from sceneprior.core.scene import Mesh
from sceneprior.paper.decoders import ShapeDecoder, ShapeDecoderConfig
from sceneprior.training.steps import full_precision


class Total3dModel(DetectorModel):
    """Size of the network."""

    shape: ShapeDecoderConfig = ShapeDecoderConfig(width=64, level=2)


class Total3dTraining(DetectorTraining):
    """Settings of the training."""

    chamfer: float = Field(1.0, ge=0)
    """Weight of the distance between mesh and true surface, in half sides of the box."""
    edges: float = Field(0.1, ge=0)
    """Weight of the mean squared edge length of a mesh, which keeps it smooth."""


class Total3dConfig(DetectorConfig):
    """Config of a run of Total3D."""

    method: Literal["total3d"] = "total3d"
    model: Total3dModel = Total3dModel()
    training: Total3dTraining = Total3dTraining()

    def make(self) -> "Total3dStage":
        return Total3dStage(Total3d(self.model, self.classes), self)


class Total3d(ViewNetwork):
    """Detects boxes and deforms a sphere into a mesh for each box."""

    def __init__(self, config: Total3dModel, classes: int):
        super().__init__()
        self.detector = Detector(config, classes)
        self.shape: ShapeDecoder = config.shape.build(config.width)

    def forward(self, found: Detections) -> tuple[Estimate, Float[Tensor, "masks vertices 3"]]:
        """Boxes, and vertices in the image's frame where each box is [-1, 1]^3."""
        features, estimate = self.detector(found)
        return estimate, self.shape(features.unsqueeze(0))[0].float()

    def reconstruct(self, found: Detections) -> tuple[Placed, list[Mesh]]:
        estimate, vertices = self(found)
        placed, faces = estimate.boxes().in_room(found), self.shape.faces.cpu().numpy()
        vertices_m = as_numpy(placed.points_m(found, vertices))
        return placed, [Mesh(each, faces) for each in vertices_m]


class Total3dStage(OneStage):
    """Learns the true boxes and surfaces of the masked objects in all sampled views. Surfaces are
    compared by the Chamfer distance between vertices and true points."""

    prior: Total3d

    def training_step(self, batch: TrueViews, batch_idx: int) -> Tensor:
        found = detections_of(batch.views)
        estimate, vertices = self.prior(found)
        with full_precision(self.device):
            true = true_objects(found, batch)
            losses = estimate_losses(found, estimate, true)
            with torch.no_grad():  # the choice of the nearest point has no gradient
                apart = torch.cdist(vertices, true.points)
                of_vertices, of_points = (apart.min(dim=dim).indices for dim in (2, 1))
            there = vertices - torch.take_along_dim(true.points, of_vertices[..., None], dim=1)
            back = true.points - torch.take_along_dim(vertices, of_points[..., None], dim=1)
            losses["chamfer"] = mean_squared_length(there) + mean_squared_length(back)
            faces = self.prior.shape.faces
            edges = vertices[:, faces] - vertices[:, faces.roll(1, dims=1)]
            losses["edges"] = mean_squared_length(edges)
            return self.total(losses, batch.views)


def mean_squared_length(vectors: Float[Tensor, "masks *many 3"]) -> Float[Tensor, ""]:
    """Mean squared length of vectors; every mask has the same weight."""
    return mean_of_masks(vectors.square().sum(dim=-1))

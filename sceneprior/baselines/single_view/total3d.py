"""The baseline Total3D: boxes and meshes from single images, learnt from true boxes and meshes.

After Nie et al., "Total3DUnderstanding", CVPR 2020; docs/baselines_single_view.md names the
differences. Im3D builds on the box detector, its losses and the true objects.
"""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.baselines.one_stage import OneStage
from sceneprior.baselines.single_view.detections import Detections, detections_of
from sceneprior.baselines.single_view.network import (
    DetectionEncoder,
    Placed,
    SingleViewConfig,
    SingleViewModel,
    SingleViewTraining,
    ViewNetwork,
    last_layer,
    meshes_of,
)
from sceneprior.baselines.single_view.truth import TrueViewDataset, TrueViews
from sceneprior.core.boxes import box_corners
from sceneprior.core.scene import Mesh
from sceneprior.paper.decoders import ShapeDecoder, ShapeDecoderConfig
from sceneprior.training.steps import full_precision

NEAREST_M, FURTHEST_M, BINS = 0.5, 10.0, 8
"""Range in metres of the distance to a centre, and the number of its bins. Bins are equally wide in
log distance, because far distances are known less exactly than near ones."""
BIN = math.log(FURTHEST_M / NEAREST_M) / BINS
"""Width of a bin of log distances."""
GEOMETRY = 64
"""Number of sines and cosines that encode the four numbers relating two 2D boxes."""


class DetectorModel(SingleViewModel):
    """Size of a network with a detector."""

    heads: int = Field(4, ge=1)
    """Attention heads over pairs of masks; must divide `width`."""

    @model_validator(mode="after")
    def _heads_share_the_width(self) -> "DetectorModel":
        if self.width % self.heads:
            raise ValueError(f"width {self.width} is not a multiple of heads {self.heads}")
        return self


class DetectorTraining(SingleViewTraining):
    """Weights of the box losses. Every sampled view of a room is an image."""

    epochs: int = Field(100, ge=1)
    box: float = Field(1.0, ge=0)
    """Weight of each loss of offsets, sizes, distance bins, residuals and refined boxes."""
    corners: float = Field(1.0, ge=0)
    """Weight of each mean distance between predicted and true box corners, in metres."""

    def weights(self, losses: Iterable[str]) -> dict[str, float]:
        """Weight of each loss: the setting of the same name, ignoring the prefix `refined_`, or
        `box` if no setting has that name."""
        return {name: getattr(self, name.removeprefix("refined_"), self.box) for name in losses}


class DetectorConfig(SingleViewConfig):
    """A run that learns from true boxes and shapes."""

    training: DetectorTraining

    dataset = TrueViewDataset

    @property
    def learns_from(self) -> str:
        return "true boxes and shapes in 3D"

    def build(self, rooms: TrueViewDataset, previous: Path | None) -> OneStage:
        stage = super().build(rooms, previous)
        stage.prior.detector.fit_statistics(*rooms.log_sizes())
        return stage


class CameraBoxes(NamedTuple):
    """One box per mask, relative to the camera."""

    offsets: Float[Tensor, "masks 2"]
    """Projected centre minus the middle of the 2D box, in units of the 2D box's sides."""
    log_distances: Float[Tensor, " masks"]
    """Log of the distance in metres from the camera to the centre."""
    log_sizes: Float[Tensor, "masks 3"]
    """Logs of the extents in metres along the axes of the image's frame."""

    def in_room(self, found: Detections) -> Placed:
        """The same boxes in the room frame."""
        return Placed.of(found, self.offsets, self.log_distances.exp(), self.log_sizes.exp())


class Estimate(NamedTuple):
    """The detector's output: boxes whose distance is a bin and a residual."""

    offsets: Float[Tensor, "masks 2"]
    log_sizes: Float[Tensor, "masks 3"]
    bin_logits: Float[Tensor, "masks bins"]
    residuals: Float[Tensor, "masks bins"]
    """For each bin, the offset of the log distance from the bin's middle, in bin widths."""

    def boxes(self, bins: Int[Tensor, " masks"] | None = None) -> CameraBoxes:
        """Boxes whose distances lie in the most likely bins, or in the given `bins`."""
        bins = self.bin_logits.argmax(dim=-1) if bins is None else bins
        place = bins + 0.5 + self.residuals.gather(1, bins.unsqueeze(-1))[:, 0]
        return CameraBoxes(self.offsets, math.log(NEAREST_M) + place * BIN, self.log_sizes)


class Relations(nn.Module):
    """Attention of each mask over all masks of its image, by features and by 2D boxes:

        w_ij ~ max(0, W g_ij) exp(q_i . k_j)

    Source: Hu et al., "Relation Networks for Object Detection", CVPR 2018.
    """

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.geometry = nn.Linear(GEOMETRY, heads)
        self.query, self.key = nn.Linear(width, width), nn.Linear(width, width)
        self.value = nn.Linear(width, width)

    def forward(
        self, found: Detections, features: Float[Tensor, "masks width"]
    ) -> Float[Tensor, "masks width"]:
        """The attended values of each mask."""
        if not len(found):
            return features
        parts = [found.padded(layer(features)) for layer in (self.query, self.key, self.value)]
        query, key, value = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        geometry = self.geometry(pair_geometry(found)).relu().clamp(min=1e-6).log()
        scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5 + geometry.movedim(-1, 1)
        scores = scores.masked_fill(~presence(found)[:, None, None], -1e9)
        attended = (scores.softmax(dim=-1) @ value).transpose(1, 2).flatten(2)
        return attended[found.image, found.slot]


def presence(found: Detections) -> Bool[Tensor, "images most"]:
    """True where a padded row of an image is a mask."""
    return found.padded(torch.ones_like(found.boxes[:, :1]))[..., 0] > 0


def pair_geometry(found: Detections) -> Float[Tensor, "images most most numbers"]:
    """Sine-cosine encoding of the relation between the 2D boxes of each pair of an image's masks:
    log distances between their middles, and log ratios of their sides."""
    boxes = found.padded(found.boxes)
    sides = (boxes[..., 2:] - boxes[..., :2]).clamp(min=1e-3)
    middles = (boxes[..., 2:] + boxes[..., :2]) / 2
    apart = (middles.unsqueeze(1) - middles.unsqueeze(2)).abs() / sides.unsqueeze(2)
    ratios = sides.unsqueeze(1) / sides.unsqueeze(2)
    numbers = torch.cat([apart.clamp(min=1e-3), ratios], dim=-1).log()
    waves = 2 ** torch.arange(GEOMETRY // 8, device=boxes.device) / 4
    angles = (numbers.unsqueeze(-1) * waves).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class Detector(nn.Module):
    """Encodes masks, applies attention between them, and predicts boxes with one layer."""

    mean_log_sizes: Tensor

    def __init__(self, config: DetectorModel, classes: int):
        super().__init__()
        self.encoder = DetectionEncoder(classes, config.width)
        self.relations = Relations(config.width, config.heads)
        self.box = last_layer(config.width, 5 + 2 * BINS)
        self.register_buffer("mean_log_sizes", torch.zeros(classes, 3))

    def fit_statistics(
        self, log_sizes: Float[Tensor, "objects 3"], object_class: Int[Tensor, " objects"]
    ) -> None:
        """Set each class's mean log size from training rooms. Width and depth get the same mean,
        because an object may be turned by a quarter."""
        level = log_sizes[:, (0, 2)].mean(dim=-1)
        log_sizes = torch.stack([level, log_sizes[:, 1], level], dim=-1)
        self.mean_log_sizes[:] = log_sizes.mean(dim=0)
        for index in object_class.unique().tolist():
            self.mean_log_sizes[index] = log_sizes[object_class == index].mean(dim=0)

    def forward(self, found: Detections) -> tuple[Float[Tensor, "masks width"], Estimate]:
        """Features and predicted boxes of masks."""
        features = self.encoder(found)
        features = features + self.relations(found, features)
        numbers = self.box(features).float()
        offsets, sizes, bins, residuals = numbers.split([2, 3, BINS, BINS], dim=-1)
        log_sizes = self.mean_log_sizes[found.object_class] + sizes
        return features, Estimate(offsets, log_sizes, bins, residuals)


class TrueObjects(NamedTuple):
    """The true object behind each mask."""

    placed: Placed
    boxes: CameraBoxes
    ahead: Bool[Tensor, " masks"]
    """True where the centre is in front of the camera; only there do `boxes.offsets` count."""
    points: Float[Tensor, "masks points 3"]
    """Points on the surface, along the axes of the image's frame; the object's box is [-1, 1]^3."""
    occupied: Bool[Tensor, "masks x y z"]
    """Occupied cells along the axes of the room."""


def true_objects(found: Detections, batch: TrueViews) -> TrueObjects:
    """The ground truth of each mask."""
    rows = (found.room, found.item)
    centers_m, sizes_m = batch.boxes_m[rows].split(3, dim=-1)
    offsets, distances_m, ahead = found.offsets_and_distances(centers_m)
    log_sizes = found.to_frame(sizes_m).abs().clamp(min=1e-3).log()
    boxes = CameraBoxes(offsets, distances_m.clamp(min=1e-3).log(), log_sizes)
    points = found.to_frame(batch.points[rows])
    return TrueObjects(Placed(centers_m, sizes_m), boxes, ahead, points, batch.occupied[rows])


def mean_of_masks(values: Tensor, counted: Tensor | None = None) -> Float[Tensor, ""]:
    """Mean over the masks in `counted` (None: all) and over all further dimensions; 0 if there are
    no such masks."""
    values = values.flatten(1).mean(dim=1) if values.ndim > 1 else values
    weights = torch.ones_like(values) if counted is None else counted.to(values)
    return (values * weights).sum() / weights.sum().clamp(min=1)


def smooth_l1(values: Tensor, target: Tensor, counted: Tensor | None = None) -> Float[Tensor, ""]:
    """Mean smooth L1 distance over the masks in `counted` (None: all)."""
    return mean_of_masks(F.smooth_l1_loss(values, target, reduction="none"), counted)


def corner_loss(found: Detections, boxes: CameraBoxes, true: TrueObjects) -> Float[Tensor, ""]:
    """Mean distance in metres, along each axis, between predicted and true box corners."""
    apart_m = box_corners(*boxes.in_room(found)) - box_corners(*true.placed)
    return mean_of_masks(apart_m.abs())


def estimate_losses(
    found: Detections, estimate: Estimate, true: TrueObjects
) -> dict[str, Float[Tensor, ""]]:
    """Losses of the detector's output; residuals and corners are compared for the true bins."""
    place = (true.boxes.log_distances - math.log(NEAREST_M)) / BIN
    bins = place.long().clamp(0, BINS - 1)
    residual = estimate.residuals.gather(1, bins.unsqueeze(-1))[:, 0]
    return {
        "offset": smooth_l1(estimate.offsets, true.boxes.offsets, true.ahead),
        "size": smooth_l1(estimate.log_sizes, true.boxes.log_sizes),
        "bin": mean_of_masks(F.cross_entropy(estimate.bin_logits, bins, reduction="none")),
        "residual": smooth_l1(residual, place - bins - 0.5),
        "corners": corner_loss(found, estimate.boxes(bins), true),
    }


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
        return Total3dStage(Total3d(self.model, self.classes), self.training)


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
        placed = estimate.boxes().in_room(found)
        return placed, meshes_of(placed.points_m(found, vertices), self.shape.faces)


class Total3dStage(OneStage):
    """Learns the true boxes and surfaces of the masked objects in all sampled views."""

    prior: Total3d
    settings: Total3dTraining

    def training_step(self, batch: TrueViews, batch_idx: int) -> Tensor:
        found = detections_of(batch.views)
        estimate, vertices = self.prior(found)
        with full_precision(self.device):
            true = true_objects(found, batch)
            losses = estimate_losses(found, estimate, true)
            losses |= mesh_losses(vertices, self.prior.shape.faces, true.points)
            return self.total(losses, self.settings.weights(losses), batch.views)


def mesh_losses(
    vertices: Float[Tensor, "masks vertices 3"],
    faces: Int[Tensor, "faces 3"],
    points: Float[Tensor, "masks points 3"],
) -> dict[str, Float[Tensor, ""]]:
    """Chamfer distance between vertices and true points, and mean squared edge length."""
    with torch.no_grad():  # the choice of the nearest point has no gradient
        apart = torch.cdist(vertices, points)
        of_vertices, of_points = (apart.min(dim=dim).indices for dim in (2, 1))
    there = vertices - torch.take_along_dim(points, of_vertices[..., None], dim=1)
    back = points - torch.take_along_dim(vertices, of_points[..., None], dim=1)
    edges = vertices[:, faces] - vertices[:, faces.roll(1, dims=1)]
    return {
        "chamfer": mean_squared_length(there) + mean_squared_length(back),
        "edges": mean_squared_length(edges),
    }


def mean_squared_length(vectors: Float[Tensor, "masks *many 3"]) -> Float[Tensor, ""]:
    """Mean squared length of vectors; every mask has the same weight."""
    return mean_of_masks(vectors.square().sum(dim=-1))

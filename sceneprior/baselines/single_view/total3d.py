"""The baseline Total3D: boxes and meshes of single images, learnt from true ones.

After Nie et al., "Total3DUnderstanding", CVPR 2020. What is published, and what is ours:
docs/baselines_single_view.md.
"""

import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.baselines.single_view.detections import Detections, detections_of
from sceneprior.baselines.single_view.network import (
    DetectionEncoder,
    Placed,
    as_numpy,
    by_image,
    last_layer,
    placed_meshes,
    sizes_in_room,
)
from sceneprior.baselines.single_view.training import (
    SingleViewConfig,
    SingleViewModel,
    SingleViewStage,
    SingleViewTraining,
)
from sceneprior.baselines.single_view.truth import TrueViewDataset, TrueViews
from sceneprior.geometry.corners import box_corners
from sceneprior.models.shape_decoder import ShapeDecoder, ShapeDecoderConfig
from sceneprior.scene import Mesh
from sceneprior.training.method import FoundObject
from sceneprior.training.objective import full_precision
from sceneprior.views import SceneViews

NEAREST_M, FURTHEST_M, BINS = 0.5, 10.0, 8
"""Bins of the distance to a centre: of equal ratios, since what is far is seen less exactly."""
BIN = math.log(FURTHEST_M / NEAREST_M) / BINS
"""The log of the ratio."""
GEOMETRY = 64
"""Sines and cosines of the four numbers that say how two 2D boxes lie."""


class RelationModel(SingleViewModel):
    """A network whose masks know of each other."""

    heads: int = Field(4, ge=1)
    """Of the attention over pairs of masks; `width` is a multiple."""

    @model_validator(mode="after")
    def _heads_share_the_width(self) -> "RelationModel":
        if self.width % self.heads:
            raise ValueError(f"width {self.width} is not a multiple of heads {self.heads}")
        return self


class Total3dModel(RelationModel):
    """The network."""

    shape: ShapeDecoderConfig = ShapeDecoderConfig(width=64, level=2)


class DetectorTraining(SingleViewTraining):
    """Weights of the terms of boxes; every view drawn from a room is an image."""

    epochs: int = Field(100, ge=1)
    box: float = Field(1.0, ge=0)
    """Of offsets, sizes, bins of distance and residuals, each by itself."""
    corners: float = Field(1.0, ge=0)
    """Of the boxes' corners, in metres: what these numbers make together."""


class Total3dTraining(DetectorTraining):
    """How the network is trained."""

    chamfer: float = Field(1.0, ge=0)
    """Of the distance between meshes and true surfaces, in half sides of the box."""
    edges: float = Field(0.1, ge=0)
    """Of the squared length of a mesh's edges, which keeps it smooth."""


class DetectorConfig(SingleViewConfig):
    """A run that learns from true boxes and shapes."""

    def open_rooms(self) -> TrueViewDataset:
        return self.views_of(TrueViewDataset)

    def build(self, rooms: TrueViewDataset, previous: Path | None) -> Any:
        stage = super().build(rooms, previous)
        stage.prior.detector.fit_statistics(*rooms.log_sizes())
        return stage


class Total3dConfig(DetectorConfig):
    """A run of Total3D."""

    method: Literal["total3d"] = "total3d"
    model: Total3dModel = Total3dModel()
    training: Total3dTraining = Total3dTraining()

    def make(self) -> "Total3dStage":
        return Total3dStage(Total3d(self.model, self.classes), self.training)


class Estimate(NamedTuple):
    """What a network says of the box behind each mask."""

    offsets: Float[Tensor, "masks 2"]
    """Of the projected centre from the 2D box's middle, in units of its sides."""
    log_sizes: Float[Tensor, "masks 3"]
    """Along the axes of the image's frame."""
    bin_logits: Float[Tensor, "masks bins"]
    residuals: Float[Tensor, "masks bins"]
    """Of each bin: from its middle, in bins."""


class Relations(nn.Module):
    """Attention of each mask over all masks of its image, by features and by how their 2D boxes lie
    (Hu et al., "Relation Networks", CVPR 2018): w_ij ~ max(0, W g_ij) exp(q_i . k_j)."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.geometry = nn.Linear(GEOMETRY, heads)
        self.query, self.key = nn.Linear(width, width), nn.Linear(width, width)
        self.value = nn.Linear(width, width)

    def forward(
        self, found: Detections, features: Float[Tensor, "masks width"]
    ) -> Float[Tensor, "masks width"]:
        """What each mask hears of the others."""
        if not len(found):
            return features
        parts = [found.padded(layer(features)) for layer in (self.query, self.key, self.value)]
        query, key, value = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        present = presence(found)
        lie = self.geometry(pair_geometry(found)).relu().clamp(min=1e-6).log()
        scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5 + lie.movedim(-1, 1)
        scores = scores.masked_fill(~present[:, None, None], -1e9)
        heard = (scores.softmax(dim=-1) @ value).transpose(1, 2).flatten(2)
        return heard[found.image, found.slot]


def presence(found: Detections) -> Bool[Tensor, "images most"]:
    """Where an image has a mask."""
    return found.padded(torch.ones_like(found.boxes[:, :1]))[..., 0] > 0


def pair_geometry(found: Detections) -> Float[Tensor, "images most most numbers"]:
    """How the second mask's 2D box lies relative to the first: log distances of the middles and log
    ratios of the sides, as sines and cosines."""
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
    """Boxes behind masks: features, what masks hear of each other, and one layer of outputs."""

    mean_log_sizes: Tensor

    def __init__(self, config: RelationModel, classes: int):
        super().__init__()
        self.encoder = DetectionEncoder(classes, config.width)
        self.relations = Relations(config.width, config.heads)
        self.box = last_layer(config.width, 5 + 2 * BINS)
        self.register_buffer("mean_log_sizes", torch.zeros(classes, 3))

    def fit_statistics(
        self, log_sizes: Float[Tensor, "objects 3"], object_class: Int[Tensor, " objects"]
    ) -> None:
        """Take each class's mean size from training rooms; width and depth are alike, since an
        object may stand either way."""
        level = log_sizes[:, (0, 2)].mean(dim=-1)
        log_sizes = torch.stack([level, log_sizes[:, 1], level], dim=-1)
        self.mean_log_sizes[:] = log_sizes.mean(dim=0)
        for index in object_class.unique().tolist():
            self.mean_log_sizes[index] = log_sizes[object_class == index].mean(dim=0)

    def forward(self, found: Detections) -> tuple[Float[Tensor, "masks width"], Estimate]:
        """Features of masks, and their boxes."""
        features = self.encoder(found)
        features = features + self.relations(found, features)
        offsets, sizes, bins, residuals = self.box(features).split([2, 3, BINS, BINS], dim=-1)
        log_sizes = self.mean_log_sizes[found.object_class] + sizes
        return features, Estimate(offsets, log_sizes, bins, residuals)


def log_distances(
    estimate: Estimate, bins: Int[Tensor, " masks"] | None = None
) -> Float[Tensor, " masks"]:
    """Logs of metres, in the likeliest bins, or in given ones."""
    bins = estimate.bin_logits.argmax(dim=-1) if bins is None else bins
    residual = estimate.residuals.gather(1, bins.unsqueeze(-1))[:, 0]
    return math.log(NEAREST_M) + (bins + 0.5 + residual) * BIN


def boxes_of(
    found: Detections, estimate: Estimate, bins: Int[Tensor, " masks"] | None = None
) -> Placed:
    """Boxes in the room."""
    distances_m = log_distances(estimate, bins).exp()
    centers_m = found.centers_at(estimate.offsets, distances_m)
    return Placed(centers_m, sizes_in_room(found, estimate.log_sizes.exp()))


class TrueObjects(NamedTuple):
    """What detections are of."""

    placed: Placed
    points: Float[Tensor, "masks points 3"]
    """In the image's frame; the box spans [-1, 1]^3."""
    occupied: Bool[Tensor, "masks x y z"]
    """In the room's."""


def true_objects(found: Detections, batch: TrueViews) -> TrueObjects:
    """The ground truth of each mask."""
    rows = (found.room, found.item)
    centers_m, sizes_m = batch.boxes_m[rows].split(3, dim=-1)
    points = found.to_frame(batch.points[rows])
    return TrueObjects(Placed(centers_m, sizes_m), points, batch.occupied[rows])


def mean_of_masks(values: Tensor, counted: Tensor | None = None) -> Float[Tensor, ""]:
    """Mean over masks (and all that follows), of those that count; 0 where there are none."""
    values = values.flatten(1).mean(dim=1) if values.ndim > 1 else values
    weights = torch.ones_like(values) if counted is None else counted.to(values)
    return (values * weights).sum() / weights.sum().clamp(min=1)


def estimate_losses(
    found: Detections, estimate: Estimate, true: Placed
) -> dict[str, Float[Tensor, ""]]:
    """Offsets, sizes, bins and residuals, and the corners that they make in the true bins."""
    offsets, distances_m, ahead = found.offsets_and_distances(true.centers_m)
    place = (distances_m.clamp(min=1e-3).log() - math.log(NEAREST_M)) / BIN
    bins = place.long().clamp(0, BINS - 1)
    residual = estimate.residuals.gather(1, bins.unsqueeze(-1))[:, 0]
    log_sizes = found.to_frame(true.sizes_m).abs().clamp(min=1e-3).log()
    smooth = F.smooth_l1_loss
    guessed = boxes_of(found, estimate, bins)
    corners = box_corners(*guessed) - box_corners(*true)
    return {
        "offset": mean_of_masks(smooth(estimate.offsets, offsets, reduction="none"), ahead),
        "size": mean_of_masks(smooth(estimate.log_sizes, log_sizes, reduction="none")),
        "bin": mean_of_masks(F.cross_entropy(estimate.bin_logits, bins, reduction="none")),
        "residual": mean_of_masks(smooth(residual, place - bins - 0.5, reduction="none")),
        "corners": mean_of_masks(corners.abs()),
    }


class Total3d(nn.Module):
    """Boxes of masks, and meshes that depart from a sphere."""

    def __init__(self, config: Total3dModel, classes: int):
        super().__init__()
        self.detector = Detector(config, classes)
        self.shape: ShapeDecoder = config.shape.build(config.width)

    def forward(self, found: Detections) -> tuple[Estimate, Float[Tensor, "masks vertices 3"]]:
        """Boxes, and vertices in the images' frames, whose boxes span [-1, 1]^3."""
        features, estimate = self.detector(found)
        return estimate, self.shape(features.unsqueeze(0))[0]

    @torch.no_grad()
    def find(self, views: SceneViews) -> list[list[FoundObject]]:
        found = detections_of(views)
        estimate, canonical = self(found)
        placed = boxes_of(found, estimate)
        vertices_m = placed_meshes(found, placed, canonical)
        faces = self.shape.faces.cpu().numpy()
        meshes = [Mesh(as_numpy(vertices), faces) for vertices in vertices_m]
        return by_image(found, placed, meshes, len(views.room_index))


class Total3dStage(SingleViewStage):
    """True boxes and surfaces, of every view that is drawn."""

    prior: Total3d
    settings: Total3dTraining

    def training_step(self, batch: TrueViews, batch_idx: int) -> Tensor:
        found = detections_of(batch.views)
        true = true_objects(found, batch)
        estimate, canonical = self.prior(found)
        with full_precision(self.device):
            estimate = Estimate(*(part.float() for part in estimate))
            losses = estimate_losses(found, estimate, true.placed)
            losses |= mesh_losses(canonical.float(), self.prior.shape.faces, true.points)
            box = self.settings.box
            weights = dict.fromkeys(("offset", "size", "bin", "residual"), box)
            weights |= self.settings.model_dump(include={"corners", "chamfer", "edges"})
            return self.total(losses, weights, batch.views)


def mesh_losses(
    canonical: Float[Tensor, "masks vertices 3"],
    faces: Int[Tensor, "faces 3"],
    points: Float[Tensor, "masks points 3"],
) -> dict[str, Float[Tensor, ""]]:
    """Squared distances between vertices and points, both ways, and of the ends of edges."""
    with torch.no_grad():  # which point is nearest has no gradient
        apart = torch.cdist(canonical, points)
        of_vertices, of_points = (apart.min(dim=dim).indices for dim in (2, 1))
    there = canonical - torch.take_along_dim(points, of_vertices[..., None], dim=1)
    back = points - torch.take_along_dim(canonical, of_points[..., None], dim=1)
    edges = canonical[:, faces] - canonical[:, faces.roll(1, dims=1)]
    return {
        "chamfer": mean_of_masks(squared(there)) + mean_of_masks(squared(back)),
        "edges": mean_of_masks(squared(edges)),
    }


def squared(vectors: Float[Tensor, "*many 3"]) -> Float[Tensor, "*many"]:
    """Of lengths."""
    return vectors.square().sum(dim=-1)

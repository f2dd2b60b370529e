"""The box detector of Total3D and Im3D, and the true boxes and shapes that it learns from.

Only Total3D and Im3D train on them; USL and the paper's method never open them
(tests/baselines/test_true_boxes.py).
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.rnn import pad_sequence

from sceneprior.baselines.one_stage import OneStage, check_ground_truth
from sceneprior.baselines.single_view.detections import (
    DetectionEncoder,
    Detections,
    Placed,
    SingleViewConfig,
    SingleViewModel,
    SingleViewTraining,
    last_layer,
)
from sceneprior.core.boxes import box_corners
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.ground_truth import reference_scene
from sceneprior.core.settings import AttentionSection
from sceneprior.core.shards import iterate_rooms
from sceneprior.core.surfaces import surface_points
from sceneprior.core.views import SceneViews
from sceneprior.render.appearance import object_mesh

POINTS = 256
"""Number of points sampled on the surface of each object."""
CELLS = 16
"""Cells along each axis of an object's grid."""
DENSE = 12288
"""Number of surface points from which occupied cells are found: about eight per surface cell of a
cube."""
NEAREST_M, FURTHEST_M, BINS = 0.5, 10.0, 8
"""Range in metres of the distance to a centre, and the number of its bins. Bins are equally wide in
log distance, because far distances are known less exactly than near ones."""
BIN = math.log(FURTHEST_M / NEAREST_M) / BINS
"""Width of a bin of log distances."""
GEOMETRY = 64
"""Number of sines and cosines that encode the four numbers relating two 2D boxes."""


class TrueViews(NamedTuple):
    """Views of rooms with the boxes and shapes of tracked objects; zeros for void and padding."""

    views: SceneViews
    boxes_m: Float[Tensor, "rooms objects 6"]
    """Centre, then full extents, in the room frame."""
    points: Float[Tensor, "rooms objects points 3"]
    """Points on the surface, in the frame in which the object's box is [-1, 1]^3."""
    occupied: Bool[Tensor, "rooms objects x y z"]
    """Cells of the box inside the object."""


class TrueViewDataset(ViewDataset):
    """A `ViewDataset` of unturned rooms with the boxes and shapes of their ground truth."""

    def __init__(self, folder: Path, split: str, **options: Any):
        super().__init__(folder, split, **options)
        true = [_read(folder, shard, room_id) for shard, room_id in iterate_rooms(folder, split)]
        self.true = [
            pad_sequence([torch.from_numpy(part) for part in parts], True)
            for parts in zip(*true, strict=True)
        ]
        """The fields of `TrueViews` after `views`."""

    def to(self, device: torch.device | str) -> "TrueViewDataset":
        """Move views, boxes and shapes to `device`."""
        super().to(device)
        self.true = [part.to(device) for part in self.true]
        return self

    def __getitems__(self, draws: list[tuple[int, int]]) -> TrueViews:  # type: ignore[override]
        views = super().__getitems__(draws)
        rooms = torch.tensor([row for row, _ in draws], device=views.boxes.device)
        most = views.is_object.shape[1]
        return TrueViews(views, *(part[rooms, :most] for part in self.true))


def _read(folder: Path, shard: Any, room_id: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    check_ground_truth(shard, room_id)
    scene = reference_scene(shard, room_id, folder, tracked_only=True)
    boxes_m = np.hstack([scene.centers_m, scene.sizes_m]).astype(np.float32)
    points = np.empty((len(boxes_m), POINTS, 3), np.float32)
    occupied = np.empty((len(boxes_m), CELLS, CELLS, CELLS), bool)
    for row, item in enumerate(scene.objects):
        mesh, half_m = object_mesh(item), np.maximum(item.size_m, 1e-6) / 2
        # The mesh is scaled to the cube first; otherwise the thin sides of a flat piece would get
        # few points.
        unit = (mesh.vertices_m - np.asarray(item.center_m)) / half_m
        occupied[row] = filled(surface_points(unit, mesh.faces, DENSE), CELLS)
        surface = surface_points(mesh.vertices_m, mesh.faces, POINTS)
        points[row] = (surface - np.asarray(item.center_m)) / half_m
    return boxes_m, points, occupied


def filled(points: Float[np.ndarray, "points 3"], cells: int) -> Bool[np.ndarray, "x y z"]:
    """Cells of [-1, 1]^3 that contain a surface point, or that lie between such cells along all
    three axes.

    A surface cell that happens to contain no point affects at most the lines through it, whereas a
    flood fill would leak there.

    Example: a sphere's inside is filled.

        >>> directions = np.random.default_rng(0).normal(size=(4000, 3))
        >>> sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        >>> grid = filled(sphere, 8)
        >>> bool(grid[4, 4, 4]), bool(grid[0, 0, 0])
        (True, False)
    """
    surface = np.zeros((cells,) * 3, dtype=bool)
    surface[tuple(((points + 1) / 2 * cells).astype(int).clip(0, cells - 1).T)] = True
    between = np.ones_like(surface)
    for axis in range(3):
        between &= np.logical_or.accumulate(surface, axis)
        between &= np.flip(np.logical_or.accumulate(np.flip(surface, axis), axis), axis)
    return surface | between


class DetectorModel(SingleViewModel, AttentionSection):
    """Size of a network with a detector."""

    heads: int = Field(4, ge=1)
    """Attention heads over pairs of masks; must divide `width`."""


class DetectorTraining(SingleViewTraining):
    """Weights of the box losses. Every sampled view of a room is an image."""

    epochs: int = Field(100, ge=1)
    box: float = Field(1.0, ge=0)
    """Weight of each loss of offsets, sizes, distance bins, residuals and refined boxes."""
    corners: float = Field(1.0, ge=0)
    """Weight of each mean distance between predicted and true box corners, in metres."""

    def weight_of(self, loss: str) -> float:
        """Weight of a loss: the setting of the same name, ignoring the prefix `refined_`, or `box`
        if no setting has that name."""
        return getattr(self, loss.removeprefix("refined_"), self.box)


class DetectorConfig(SingleViewConfig):
    """A run that learns from true boxes and shapes."""

    training: DetectorTraining

    dataset = TrueViewDataset

    @property
    def learns_from(self) -> str:
        return "true boxes and shapes in 3D"

    def build(self, rooms: TrueViewDataset, previous: Path | None) -> OneStage:
        stage = super().build(rooms, previous)
        stage.prior.detector.fit_statistics(rooms)
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
        centers_m = found.centers_at(self.offsets, self.log_distances.exp())
        return Placed(centers_m, found.to_room(self.log_sizes.exp()).abs())


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

    def fit_statistics(self, rooms: TrueViewDataset) -> None:
        """Set each class's mean log size from training rooms. Width and depth get the same mean,
        because an object may be turned by a quarter."""
        boxes_m, object_class = rooms.true[0], rooms.flat.object_class[:-1]  # the last is padding
        there = torch.arange(boxes_m.shape[1]) < rooms.flat.object_count[:, None]
        log_sizes = boxes_m[there][:, 3:].clamp(min=1e-3).log()
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

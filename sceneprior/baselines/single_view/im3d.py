"""The baseline Im3D: Total3D's boxes, refined over a graph of the scene; implicit shapes.

After Zhang et al., "Holistic 3D Scene Understanding from a Single Image with Implicit Scene
Representation", CVPR 2021. What is published, and what is ours: docs/baselines_single_view.md.
"""

from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.baselines.single_view.detections import Detections, detections_of
from sceneprior.baselines.single_view.network import (
    Placed,
    as_numpy,
    by_image,
    last_layer,
    sizes_in_room,
)
from sceneprior.baselines.single_view.total3d import (
    GEOMETRY,
    Detector,
    DetectorConfig,
    DetectorTraining,
    Estimate,
    RelationModel,
    TrueObjects,
    boxes_of,
    estimate_losses,
    log_distances,
    mean_of_masks,
    pair_geometry,
    presence,
    true_objects,
)
from sceneprior.baselines.single_view.training import SingleViewStage
from sceneprior.baselines.single_view.truth import CELLS, TrueViews
from sceneprior.geometry.corners import box_corners
from sceneprior.geometry.isosurface import surface_of
from sceneprior.geometry.turns import turn_vectors
from sceneprior.models.layers import mlp
from sceneprior.scene import Mesh
from sceneprior.training.method import FoundObject
from sceneprior.training.objective import full_precision
from sceneprior.views import SceneViews

STEEP, LEVEL = 10.0, 0.5
"""A point is inside where the sum of an object's Gaussians exceeds `LEVEL`; the logit of that is
the excess times `STEEP`."""
FINE = 32
"""Cells along each side of the grid that a mesh is taken from."""


class Im3dModel(RelationModel):
    """The network."""

    rounds: int = Field(3, ge=1)
    """Of messages over the graph."""
    blobs: int = Field(32, ge=1)
    """Gaussians whose sum is a shape."""


class Im3dTraining(DetectorTraining):
    """How the network is trained; the terms of boxes count before and after refinement."""

    shape: float = Field(1.0, ge=0)
    """Of the occupancy of points in the true boxes."""
    overlap: float = Field(0.1, ge=0)
    """Of how much of the objects of an image is inside one another."""
    points: int = Field(128, ge=1)
    """Cells of each true box that are asked for in a step."""


class Im3dConfig(DetectorConfig):
    """A run of Im3D."""

    method: Literal["im3d"] = "im3d"
    model: Im3dModel = Im3dModel()
    training: Im3dTraining = Im3dTraining()

    def make(self) -> "Im3dStage":
        return Im3dStage(Im3d(self.model, self.classes), self.training)


class Blobs(nn.Module):
    """Shapes as sums of Gaussians in the box's frame [-1, 1]^3 (structured implicit functions).

    f(x) = sum_k w_k exp(-|(x - p_k) / r_k|^2 / 2),    inside where f > LEVEL
    """

    start: Tensor

    def __init__(self, width: int, count: int):
        super().__init__()
        self.layer = last_layer(width, 7 * count)
        spread = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
        self.register_buffer("start", 1.6 * spread - 0.8)

    def forward(self, features: Float[Tensor, "masks width"]) -> Float[Tensor, "masks blobs 7"]:
        """Places, logs of radii, logs of weights."""
        blobs = self.layer(features).unflatten(-1, (-1, 7))
        places, log_radii, log_weights = blobs.split([3, 3, 1], dim=-1)
        places = (self.start + places).clamp(-1.2, 1.2)
        return torch.cat([places, log_radii - 1.0, log_weights - 0.7], dim=-1)


def occupancy_logits(
    blobs: Float[Tensor, "*batch blobs 7"], points: Float[Tensor, "*batch points 3"]
) -> Float[Tensor, "*batch points"]:
    """Positive inside; points in the frame of the box."""
    places, log_radii, log_weights = blobs.split([3, 3, 1], dim=-1)
    # |(x - p) / r|^2 as products: there are masks times points times blobs of them.
    inverse = torch.exp(-2 * log_radii)
    squares = points**2 @ inverse.transpose(-1, -2)
    squares = squares - 2 * points @ (places * inverse).transpose(-1, -2)
    squares = squares + (places**2 * inverse).sum(dim=-1).unsqueeze(-2)
    gaussians = torch.exp(log_weights[..., 0].unsqueeze(-2) - squares.clamp(min=0) / 2)
    return STEEP * (gaussians.sum(dim=-1) - LEVEL)


class SceneGraph(nn.Module):
    """Refines boxes by messages: masks are nodes, ordered pairs of an image's masks are edges, and
    both are renewed in every round."""

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
        self, found: Detections, features: Float[Tensor, "masks width"], start: Placed
    ) -> tuple[Float[Tensor, "masks width"], Float[Tensor, "masks 6"]]:
        """Features that know of the other objects; and what changes: offsets (2), the log of the
        distance, logs of sizes (3)."""
        away = found.to_frame(start.centers_m - found.eye_m)
        box = torch.cat([away, found.to_frame(start.sizes_m).abs().log()], dim=-1)
        nodes = self.node(torch.cat([features, box], dim=-1)).relu()
        if not len(found):
            return nodes, self.change(nodes)
        present = presence(found)
        pairs = (present.unsqueeze(1) & present.unsqueeze(2)).unsqueeze(-1)
        boxes = found.padded(box)
        apart = boxes.unsqueeze(1) - boxes.unsqueeze(2)
        edges = self.edge(torch.cat([pair_geometry(found), apart], dim=-1)).relu()
        for _ in range(self.rounds):
            spread = found.padded(nodes)
            mine = spread.unsqueeze(2).expand(-1, -1, spread.shape[1], -1)
            theirs = spread.unsqueeze(1).expand(-1, spread.shape[1], -1, -1)
            edges = edges + self.renew_edge(torch.cat([mine, theirs, edges], dim=-1))
            heard = (self.message(edges.relu()) * pairs).sum(dim=2)
            heard = heard / pairs.sum(dim=2).clamp(min=1)
            nodes = self.renew_node(heard[found.image, found.slot], nodes)
        return nodes, self.change(nodes)


class Im3d(nn.Module):
    """Total3D's detector, the graph, and a shape of each object as it is after both."""

    def __init__(self, config: Im3dModel, classes: int):
        super().__init__()
        self.detector = Detector(config, classes)
        self.graph = SceneGraph(config.width, config.rounds)
        self.blobs = Blobs(config.width, config.blobs)

    def forward(
        self, found: Detections
    ) -> tuple[Estimate, Estimate, Float[Tensor, " masks"], Float[Tensor, "masks blobs 7"]]:
        """The start; the same after refinement, and its log distances; shapes."""
        features, first = self.detector(found)
        # What is refined is what the detector says when it is used, in its likeliest bins.
        start = Placed(*(part.detach() for part in boxes_of(found, first)))
        features, change = self.graph(found, features, start)
        offsets, log_distance, log_sizes = change.split([2, 1, 3], dim=-1)
        refined = first._replace(
            offsets=first.offsets.detach() + offsets,
            log_sizes=first.log_sizes.detach() + log_sizes,
        )
        log_distances_m = log_distances(first).detach() + log_distance[:, 0]
        return first, refined, log_distances_m, self.blobs(features)

    @torch.no_grad()
    def find(self, views: SceneViews) -> list[list[FoundObject]]:
        found = detections_of(views)
        _, refined, log_distances_m, blobs = self(found)
        placed = refined_boxes(found, refined, log_distances_m)
        centers = cell_centers(FINE).to(blobs)
        points = found.to_frame(centers.expand(len(found), -1, -1))
        logits = as_numpy(occupancy_logits(blobs, points)).reshape(-1, FINE, FINE, FINE)
        boxes = (as_numpy(part) for part in placed)
        meshes = [Mesh(*surface_of(*parts)) for parts in zip(logits, *boxes, strict=True)]
        return by_image(found, placed, meshes, len(views.room_index))


def refined_boxes(
    found: Detections, refined: Estimate, log_distances_m: Float[Tensor, " masks"]
) -> Placed:
    """Boxes in the room."""
    centers_m = found.centers_at(refined.offsets, log_distances_m.exp())
    return Placed(centers_m, sizes_in_room(found, refined.log_sizes.exp()))


def cell_centers(cells: int) -> Float[Tensor, "points 3"]:
    """Of a grid that fills [-1, 1]^3, x first."""
    along = (torch.arange(cells) + 0.5) / cells * 2 - 1
    return torch.cartesian_prod(along, along, along)


class Im3dStage(SingleViewStage):
    """True boxes and occupied cells, of every view that is drawn."""

    prior: Im3d
    settings: Im3dTraining

    def training_step(self, batch: TrueViews, batch_idx: int) -> Tensor:
        found = detections_of(batch.views)
        true = true_objects(found, batch)
        first, refined, log_distances_m, blobs = self.prior(found)
        with full_precision(self.device):
            losses = estimate_losses(found, first, true.placed)
            losses |= refined_losses(found, refined, log_distances_m, true.placed)
            placed = refined_boxes(found, refined, log_distances_m)
            losses["shape"] = occupancy_loss(found, blobs, true, self.settings.points)
            losses["overlap"] = overlap_loss(found, placed, blobs.detach())
            box, corners = self.settings.box, self.settings.corners
            weights = dict.fromkeys(("offset", "size", "bin", "residual", "refined"), box)
            weights |= {"corners": corners, "refined_corners": corners}
            weights |= self.settings.model_dump(include={"shape", "overlap"})
            return self.total(losses, weights, batch.views)


def refined_losses(
    found: Detections, refined: Estimate, log_distances_m: Float[Tensor, " masks"], true: Placed
) -> dict[str, Float[Tensor, ""]]:
    """Of the refined numbers, and of the corners that they make."""
    offsets, distances_m, ahead = found.offsets_and_distances(true.centers_m)
    log_sizes = found.to_frame(true.sizes_m).abs().clamp(min=1e-3).log()
    true_log = distances_m.clamp(min=1e-3).log()
    smooth = F.smooth_l1_loss
    corners = box_corners(*refined_boxes(found, refined, log_distances_m)) - box_corners(*true)
    numbers = (
        mean_of_masks(smooth(refined.offsets, offsets, reduction="none"), ahead)
        + mean_of_masks(smooth(refined.log_sizes, log_sizes, reduction="none"))
        + mean_of_masks(smooth(log_distances_m, true_log, reduction="none"))
    )
    return {"refined": numbers, "refined_corners": mean_of_masks(corners.abs())}


def occupancy_loss(
    found: Detections, blobs: Float[Tensor, "masks blobs 7"], true: TrueObjects, count: int
) -> Float[Tensor, ""]:
    """Binary cross entropy of `count` cells of each true box, drawn at random."""
    cells = torch.randint(CELLS**3, (len(found), count), device=blobs.device)
    centers = cell_centers(CELLS).to(blobs)[cells]
    inside = true.occupied.flatten(1).gather(1, cells).to(blobs)
    logits = occupancy_logits(blobs, found.to_frame(centers))
    return mean_of_masks(F.binary_cross_entropy_with_logits(logits, inside, reduction="none"))


def overlap_loss(
    found: Detections, placed: Placed, blobs: Float[Tensor, "masks blobs 7"]
) -> Float[Tensor, ""]:
    """How deep the middles of an object's Gaussians are inside the other objects of its image.

    Mean over ordered pairs of objects of max(0, 2 sigmoid(logit) - 1), of middles that are inside
    their own object. Shapes are given; boxes move apart.
    """
    own = occupancy_logits(blobs, blobs[..., :3]) > 0
    middles_m = found.to_room(blobs[..., :3]) * placed.sizes_m.unsqueeze(1) / 2
    middles_m = middles_m + placed.centers_m.unsqueeze(1)
    together = found.image.unsqueeze(0) == found.image.unsqueeze(1)
    one, other = together.fill_diagonal_(False).nonzero(as_tuple=True)
    away_m = middles_m[one] - placed.centers_m[other].unsqueeze(1)
    unit = away_m / (placed.sizes_m[other].unsqueeze(1) / 2).clamp(min=1e-3)
    logits = occupancy_logits(blobs[other], turn_vectors(unit, found.quarter[other]))
    return mean_of_masks((2 * logits.sigmoid() - 1).clamp(min=0) * own[one])

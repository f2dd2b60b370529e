"""The baseline USL: boxes and meshes of single images, learnt from the masks of other views alone.

After Gkioxari et al., "Learning 3D Object Shape and Layout without 3D Supervision", CVPR 2022. What
is published, and what is ours: docs/baselines_single_view.md.
"""

from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor, nn

from sceneprior.baselines.single_view.detections import Detections, detections_of, one_view
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
from sceneprior.data.dataset import ViewDataset
from sceneprior.geometry.cameras import boxes_of_points
from sceneprior.losses.averages import mean_of_objects
from sceneprior.losses.layout import box_loss, frustum_loss
from sceneprior.losses.shape import soft_iou
from sceneprior.models.shape_decoder import ShapeDecoder, ShapeDecoderConfig
from sceneprior.scene import Mesh
from sceneprior.silhouettes.render import render_silhouettes
from sceneprior.training.method import FoundObject
from sceneprior.training.objective import full_precision
from sceneprior.views import SceneViews

START_M = 3.0
"""Distance at which every object is believed to stand before training; its size follows from that
of its mask."""


class UslModel(SingleViewModel):
    """The network."""

    shape: ShapeDecoderConfig = ShapeDecoderConfig(width=64, level=2, template="box", fit_box=True)


class UslTraining(SingleViewTraining):
    """How the network is trained. Of the views drawn from a room, one is the image."""

    epochs: int = Field(200, ge=1)
    box: float = Field(5.0, ge=0)
    """Weight of 2D boxes in the other views: silhouettes that do not meet their masks have no
    gradient."""
    frustum: float = Field(1.0, ge=0)
    """Weight of the rays to objects that other views see, but not where they are predicted."""
    mask: float = Field(1.0, ge=0)
    """Weight of silhouettes in the other views."""
    occlusion_slack: float = Field(0.15, ge=0, le=1)
    """As of `LossConfig`."""
    silhouettes: Literal["exact", "fast"] = "fast"
    """As of `ShapeConfig`."""


class UslConfig(SingleViewConfig):
    """A run of USL."""

    method: Literal["usl"] = "usl"
    model: UslModel = UslModel()
    training: UslTraining = UslTraining()

    def make(self) -> "UslStage":
        return UslStage(Usl(self.model, self.classes), self.training)

    def open_rooms(self) -> ViewDataset:
        return self.views_of()


class Predicted(NamedTuple):
    """Of masks: boxes and meshes in the room."""

    placed: Placed
    vertices_m: Float[Tensor, "masks vertices 3"]


class Usl(nn.Module):
    """Each mask by itself: how far its object is, where its centre lies behind the mask, how large
    it is, and by how much its mesh departs from a template."""

    def __init__(self, config: UslModel, classes: int):
        super().__init__()
        self.encoder = DetectionEncoder(classes, config.width)
        self.box = last_layer(config.width, 6)
        self.shape: ShapeDecoder = config.shape.build(config.width)

    def forward(self, found: Detections) -> Predicted:
        """Where training begins, objects stand `START_M` away and are as large as their masks."""
        features = self.encoder(found)
        offsets, log_distance, log_sizes = self.box(features).split([2, 1, 3], dim=-1)
        distances_m = START_M * log_distance[:, 0].exp()
        sides = (found.boxes[:, 2:] - found.boxes[:, :2]).clamp(min=1e-3)
        seen_m = sides / found.intrinsics[:, (0, 1), (0, 1)] * distances_m.unsqueeze(-1)
        wide_m, high_m = seen_m.unbind(dim=-1)
        sizes_m = torch.stack([wide_m, high_m, wide_m], dim=-1) * log_sizes.exp()
        placed = Placed(found.centers_at(offsets, distances_m), sizes_in_room(found, sizes_m))
        canonical = self.shape(features.unsqueeze(0))[0]
        return Predicted(placed, placed_meshes(found, placed, canonical))

    @torch.no_grad()
    def find(self, views: SceneViews) -> list[list[FoundObject]]:
        found = detections_of(views)
        placed, vertices_m = self(found)
        faces = self.shape.faces.cpu().numpy()
        meshes = [Mesh(as_numpy(vertices), faces) for vertices in vertices_m]
        return by_image(found, placed, meshes, len(views.room_index))


class UslStage(SingleViewStage):
    """What one view shows, held against the masks of the other views."""

    prior: Usl
    settings: UslTraining

    def training_step(self, views: SceneViews, batch_idx: int) -> Tensor:
        found = detections_of(one_view(views, 0))
        others = one_view(views, 1, views.visible.shape[1])
        predicted = self.prior(found)
        with full_precision(self.device):
            losses = other_view_losses(
                found, predicted, self.prior.shape.faces, others, self.settings
            )
            weights = self.settings.model_dump(include={"box", "frustum", "mask"})
            return self.total(losses, weights, views)


def other_view_losses(
    found: Detections,
    predicted: Predicted,
    faces: Tensor,
    others: SceneViews,
    settings: UslTraining,
) -> dict[str, Float[Tensor, ""]]:
    """Terms of the 2D boxes, of what leaves the view, and of the silhouettes; means over objects.

    The silhouette of each object is drawn alone. Where another object is seen, nobody knows
    whether it goes on behind, so those pixels do not count:

        L_mask = 1 - IoU(silhouette, mask) over the other pixels
    """
    rooms, objects = others.is_object.shape
    answered = found.of_objects(torch.ones_like(found.image, dtype=torch.bool), rooms, objects)
    vertices_m = found.of_objects(predicted.vertices_m.float(), rooms, objects)
    centers_m = found.of_objects(predicted.placed.centers_m.float(), rooms, objects)
    cameras = (others.world_to_camera, others.intrinsics)
    boxes, inside = boxes_of_points(vertices_m, *cameras, others.image_size)
    seen = others.visible & answered.unsqueeze(1)
    counted = seen & inside
    box = box_loss(boxes, others.boxes, others.sides_clear, counted, settings.occlusion_slack)
    height, width = others.observed_ids.shape[-2:]
    silhouettes = render_silhouettes(
        vertices_m,
        faces,
        others.world_to_camera,
        others.intrinsics_at(height, width),
        (height, width),
        mode=settings.silhouettes,
        compositing="alone",
        drawn=answered,
    )
    return {
        "box": box,
        "frustum": frustum_loss(centers_m, others, seen & ~inside),
        "mask": silhouette_loss(silhouettes, others, counted),
    }


def silhouette_loss(
    silhouettes: Float[Tensor, "rooms views objects height width"],
    others: SceneViews,
    counted: Bool[Tensor, "rooms views objects"],
) -> Float[Tensor, ""]:
    """1 - IoU over the pixels that show the object or nothing: mean over views, then objects."""
    room, view, item = counted.nonzero(as_tuple=True)
    ids = others.observed_ids[room, view]
    own = (ids == (item + 1)[:, None, None]).to(silhouettes)
    known = own + (ids == 0).to(silhouettes)
    apart = 1 - soft_iou(silhouettes[room, view, item] * known, own)
    views_of_each = counted.sum(dim=1)
    each = apart / views_of_each[room, item]
    per_object = silhouettes.new_zeros(views_of_each.shape)
    per_object = per_object.index_put((room, item), each, accumulate=True)
    return mean_of_objects(per_object, views_of_each > 0)

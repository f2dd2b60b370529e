"""The baseline USL: boxes and meshes of single images, learnt from the masks of other views alone.

After Gkioxari et al., "Learning 3D Object Shape and Layout without 3D Supervision", CVPR 2022;
docs/baselines_single_view.md names the differences.
"""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field, model_validator
from torch import Tensor

from sceneprior.baselines.one_stage import OneStage
from sceneprior.baselines.single_view.detections import (
    DetectionEncoder,
    Detections,
    Placed,
    SingleViewConfig,
    SingleViewModel,
    SingleViewTraining,
    ViewNetwork,
    as_numpy,
    detections_of,
    last_layer,
    some_views,
)
from sceneprior.core.cameras import boxes_of_points
from sceneprior.core.scene import Mesh
from sceneprior.core.views import SceneViews
from sceneprior.paper.decoders import ShapeDecoder, ShapeDecoderConfig
from sceneprior.paper.losses import box_loss, frustum_loss, mean_of_objects, soft_iou
from sceneprior.render.silhouettes.render import render_silhouettes
from sceneprior.training.steps import full_precision

START_M = 3.0
"""Distance of every object before training; its size then follows from its mask."""


class UslModel(SingleViewModel):
    """Size of the network."""

    shape: ShapeDecoderConfig = ShapeDecoderConfig(width=64, level=2, template="box", fit_box=True)


class UslTraining(SingleViewTraining):
    """Settings of the training. The first of the views drawn from a room is the image, and the
    others supervise it."""

    epochs: int = Field(200, ge=1)
    box: float = Field(5.0, ge=0)
    """Weight of the 2D-box loss in the other views, needed because silhouettes that miss their
    masks have no gradient."""
    frustum: float = Field(1.0, ge=0)
    """Weight of the frustum loss, for objects that are visible in another view but predicted
    outside its frustum."""
    mask: float = Field(1.0, ge=0)
    """Weight of the silhouette loss in the other views."""
    occlusion_slack: float = Field(0.15, ge=0, le=1)
    """Weight of the distance by which a predicted 2D box extends beyond the observed one at a side
    where another object may occlude it; at 0, objects may extend behind others without limit."""
    silhouettes: Literal["exact", "fast"] = "fast"
    """`exact`: every face near a pixel counts; `fast`: the outline alone, in less time."""


class UslConfig(SingleViewConfig):
    """Config of a run of USL."""

    method: Literal["usl"] = "usl"
    model: UslModel = UslModel()
    training: UslTraining = UslTraining()

    @model_validator(mode="after")
    def _compares_views(self) -> "UslConfig":
        if self.data.views_per_room < 2:
            raise ValueError(
                "data.views_per_room is 1, but method: usl learns from pairs of views of a room; "
                "set it to 2 or more"
            )
        return self

    def make(self) -> "UslStage":
        return UslStage(Usl(self.model, self.classes), self)


class Usl(ViewNetwork):
    """Predicts each object from its mask alone: the offset of its centre, its distance, its size,
    and the deformation of a template mesh."""

    def __init__(self, config: UslModel, classes: int):
        super().__init__()
        self.encoder = DetectionEncoder(classes, config.width)
        self.box = last_layer(config.width, 6)
        self.shape: ShapeDecoder = config.shape.build(config.width)

    def forward(self, found: Detections) -> tuple[Placed, Float[Tensor, "masks vertices 3"]]:
        """Boxes, and vertices in metres. Network outputs of 0 place an object at a distance of
        `START_M`, with the size that its 2D box has there."""
        features = self.encoder(found)
        offsets, log_distance, log_sizes = self.box(features).split([2, 1, 3], dim=-1)
        distances_m = START_M * log_distance[:, 0].exp()
        sides = (found.boxes[:, 2:] - found.boxes[:, :2]).clamp(min=1e-3)
        seen_m = sides / found.intrinsics[:, (0, 1), (0, 1)] * distances_m.unsqueeze(-1)
        width_m, height_m = seen_m.unbind(dim=-1)
        sizes_m = torch.stack([width_m, height_m, width_m], dim=-1) * log_sizes.exp()
        placed = Placed(found.centers_at(offsets, distances_m), found.to_room(sizes_m).abs())
        vertices = self.shape(features.unsqueeze(0))[0]
        return placed, placed.points_m(found, vertices)

    def reconstruct(self, found: Detections) -> tuple[Placed, list[Mesh]]:
        placed, vertices_m = self(found)
        faces = self.shape.faces.cpu().numpy()
        return placed, [Mesh(vertices, faces) for vertices in as_numpy(vertices_m)]


class UslStage(OneStage):
    """Compares predictions from one view with the masks of the other views.

    The losses are means over objects: on 2D boxes, on silhouettes, and, where an object is
    predicted outside a view that shows it, the frustum loss (`frustum_loss`). Each silhouette is
    rendered alone. The object may continue behind other objects, so pixels that show another object
    are left out:

        L_mask = 1 - IoU(silhouette, mask) over the remaining pixels
    """

    prior: Usl
    settings: UslTraining

    def training_step(self, views: SceneViews, batch_idx: int) -> Tensor:
        found = detections_of(some_views(views, slice(1)))
        others = some_views(views, slice(1, None))
        placed, vertices_m = self.prior(found)
        with full_precision(self.device):
            shape = others.is_object.shape
            predicted = found.of_objects(torch.ones_like(found.image, dtype=torch.bool), *shape)
            vertices_m = found.of_objects(vertices_m.float(), *shape)
            centers_m = found.of_objects(placed.centers_m.float(), *shape)
            cameras = (others.world_to_camera, others.intrinsics)
            boxes, inside = boxes_of_points(vertices_m, *cameras, others.image_size)
            seen = others.visible & predicted.unsqueeze(1)
            counted = seen & inside
            height, width = others.observed_ids.shape[-2:]
            silhouettes = render_silhouettes(
                vertices_m,
                self.prior.shape.faces,
                others.world_to_camera,
                others.mask_intrinsics(),
                (height, width),
                mode=self.settings.silhouettes,
                compositing="alone",
                drawn=predicted,
            )
            slack = self.settings.occlusion_slack
            losses = {
                "box": box_loss(boxes, others.boxes, others.sides_clear, counted, slack),
                "frustum": frustum_loss(centers_m, others, seen & ~inside),
                "mask": silhouette_loss(silhouettes, others, counted),
            }
            return self.total(losses, views)


def silhouette_loss(
    silhouettes: Float[Tensor, "rooms views objects height width"],
    others: SceneViews,
    counted: Bool[Tensor, "rooms views objects"],
) -> Float[Tensor, ""]:
    """1 - IoU over the pixels that show the object or nothing: the mean over views, then over
    objects."""
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

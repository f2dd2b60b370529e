"""The layout loss: class, box, completeness and frustum terms (section 3.4, Eq. 7 and S4)."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.core.cameras import Boxes2D, camera_centers, pixel_rays
from sceneprior.core.views import DecodedScenes, LiftedRooms, SceneViews
from sceneprior.paper.losses.averages import mean_of_objects, share_of_batch
from sceneprior.paper.losses.completeness import completeness_targets
from sceneprior.paper.losses.matching import Matches, side_distance


def take(values: Tensor, index: Int[Tensor, "rooms objects"], dim: int) -> Tensor:
    """Reorder predictions (axis `dim`; axis 0 is rooms) to the order of their matched objects."""
    shape = [1] * values.dim()
    shape[0], shape[dim] = index.shape
    return torch.take_along_dim(values, index.reshape(shape), dim)


def layout_losses(
    scenes: DecodedScenes,
    boxes_2d: Boxes2D,
    views: SceneViews,
    matches: Matches,
    occlusion_slack: float = 1.0,
    completeness_target: str = "first_n",
    per_room: bool = False,
) -> dict[str, Float[Tensor, "*rooms"]]:
    """The four terms of the layout loss (Eq. 7), unweighted.

        L_L = lambda_l L_l + lambda_box L_box + lambda_p L_p + lambda_f L_f

    Each term is averaged over the objects that it applies to: in training, over the batches of all
    processes (`share_of_batch`); with `per_room`, over each room alone, for rooms that are fitted.
    `boxes_2d` holds the predictions' boxes in the views. `occlusion_slack` is explained in
    `side_distance`; `completeness_target` is a convention of `paper/losses/completeness.py`.
    """
    predicted = take(boxes_2d.boxes, matches.prediction, dim=2)
    inside = take(boxes_2d.in_frustum, matches.prediction, dim=2)
    centers = take(scenes.centers_m, matches.prediction, dim=1)
    seen = views.visible & matches.valid.unsqueeze(1)
    return {
        "class": class_loss(scenes, views, matches, per_room),
        "box": box_loss(
            predicted, views.boxes, views.sides_clear, seen & inside, occlusion_slack, per_room
        ),
        "completeness": completeness_loss(scenes, views, completeness_target, per_room),
        "frustum": frustum_loss(centers, views, seen & ~inside, per_room),
    }


def class_loss(
    scenes: DecodedScenes,
    views: SceneViews | LiftedRooms,
    matches: Matches,
    per_room: bool = False,
) -> Float[Tensor, "*rooms"]:
    """L_l of Eq. 7: cross entropy between each object's class and its matched prediction."""
    logits = take(scenes.class_logits, matches.prediction, dim=1)
    each = F.cross_entropy(logits.flatten(0, 1), views.object_class.flatten(), reduction="none")
    return mean_of_objects(each.unflatten(0, logits.shape[:2]), matches.valid, per_room)


def box_loss(
    predicted: Float[Tensor, "rooms views objects 4"],
    target: Float[Tensor, "rooms views objects 4"],
    clear: Bool[Tensor, "rooms views objects 4"],
    counted: Bool[Tensor, "rooms views objects"],
    occlusion_slack: float = 1.0,
    per_room: bool = False,
) -> Float[Tensor, "*rooms"]:
    """L_box of Eq. 7: L1 distance of 2D boxes (`side_distance`, summed over the four sides),
    averaged over visible views, then over objects."""
    apart = [
        side_distance(predicted[..., i], target[..., i], clear[..., i], i, occlusion_slack)
        for i in range(4)
    ]
    return _mean_of_views(torch.stack(apart).sum(dim=0), counted, per_room)


def completeness_loss(
    scenes: DecodedScenes,
    views: SceneViews | LiftedRooms,
    target: str = "first_n",
    per_room: bool = False,
) -> Float[Tensor, "*rooms"]:
    """L_p of Eq. 7: binary cross entropy of all completeness scores. `target` is the convention of
    their targets (`completeness_targets`)."""
    logits = scenes.completeness_logits
    wanted = completeness_targets(views.is_object.sum(dim=-1), logits.shape[1], target)
    wanted = wanted.to(logits.dtype)
    if per_room:
        every = F.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
        return every.mean(dim=1)
    mean = F.binary_cross_entropy_with_logits(logits, wanted)
    return mean * share_of_batch(views.is_object.any(dim=-1).sum())


def frustum_loss(
    centers_m: Float[Tensor, "rooms objects 3"],
    views: SceneViews,
    counted: Bool[Tensor, "rooms views objects"],
    per_room: bool = False,
) -> Float[Tensor, "*rooms"]:
    """1 - cosine between the rays to a prediction and through its object's 2D centre (Eq. S4).

        L_f = 1/|T^o| sum_(q in T^o) 1 - cos(c_k - c_cam^q, ray_q)

    T^o are the views in which the object is visible but its prediction is outside the frustum;
    other views do not count (supplement B).
    """
    height, width = views.image_size
    size = views.boxes.new_tensor([width, height])
    middle = (views.boxes[..., :2] + views.boxes[..., 2:]) / 2 * size
    target = pixel_rays(middle, views.world_to_camera, views.intrinsics)
    ray = centers_m.unsqueeze(1) - camera_centers(views.world_to_camera).unsqueeze(2)
    return _mean_of_views(1 - F.cosine_similarity(ray, target, dim=-1), counted, per_room)


def _mean_of_views(
    values: Float[Tensor, "rooms views objects"],
    counted: Bool[Tensor, "rooms views objects"],
    per_room: bool,
) -> Float[Tensor, "*rooms"]:
    weights = counted.to(values.dtype)
    per_object = (values * weights).sum(dim=1) / weights.sum(dim=1).clamp(min=1)
    return mean_of_objects(per_object, counted.any(dim=1), per_room)

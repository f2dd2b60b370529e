"""Predictions in views: their 2D boxes (section 3.4), and their Hungarian matching to tracked
objects (supplement B, Eq. S2 and S3)."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.core.cameras import Boxes2D, boxes_of_points
from sceneprior.core.proxies import beveled_cube, boxes_of_ellipsoids, place
from sceneprior.core.views import DecodedScenes, SceneViews


def first_predictions(views: SceneViews, slots: int) -> Bool[Tensor, "rooms slots"]:
    """Mask of the first n predictions of each room with n tracked objects: only these are
    matched."""
    return F.pad(views.is_object, (0, slots - views.is_object.shape[1]))


def seen_boxes(
    scenes: DecodedScenes, views: SceneViews, proxy: str, box_from: str = "proxy"
) -> Boxes2D:
    """2D boxes of decoded objects, computed from the shapes that `StageConfig.proxy` and
    `ShapeConfig.box_from` name; those of objects without a mesh are computed from the proxy.

    In a room with n tracked objects, only the first n predictions, which are matched, get a box;
    the others get empty boxes, and count as outside the frustum.
    """
    project, shapes = _solids(scenes, proxy, box_from)
    rooms, slots = scenes.centers_m.shape[:2]
    first = views.object_places
    cameras = (views.world_to_camera[first[0]], views.intrinsics[first[0]], views.image_size)
    # Each prediction is projected as a room with a single object.
    found = project(*(values[first].unsqueeze(1) for values in shapes), *cameras)
    return Boxes2D(*(
        of.new_zeros(rooms, slots, *of.shape[1:2], *of.shape[3:])
        .index_put(first, of[:, :, 0])
        .transpose(1, 2)
        for of in found
    ))  # fmt: skip


def proxy_boxes(scenes: DecodedScenes, views: SceneViews, proxy: str) -> Boxes2D:
    """2D boxes of all predictions, computed from the shapes that `StageConfig.proxy` names. They
    have the same shape in every batch (`seen_boxes` saves work)."""
    project, shapes = _solids(scenes, proxy, "proxy")
    return project(*shapes, views.world_to_camera, views.intrinsics, views.image_size)


def _solids(
    scenes: DecodedScenes, proxy: str, box_from: str
) -> tuple[Callable[..., Boxes2D], tuple[Tensor, ...]]:
    """The function that projects objects to their 2D boxes, and its first arguments."""
    boxes_m = (scenes.centers_m, scenes.sizes_m)
    if scenes.vertices_m is not None and box_from == "mesh":
        return boxes_of_points, (scenes.vertices_m,)
    if proxy == "ellipsoid":
        return boxes_of_ellipsoids, boxes_m
    assert scenes.bevels is not None, "decode() gives every object bevels"
    return boxes_of_points, (place(beveled_cube(scenes.bevels), *boxes_m),)


class Matches(NamedTuple):
    """The matched prediction of each tracked object."""

    prediction: Int[Tensor, "rooms objects"]
    """Index of the matched prediction; 0 for padding, arbitrary for objects that are visible in no
    sampled view."""
    valid: Bool[Tensor, "rooms objects"]
    """False for padding and for objects that are visible in no sampled view."""


@torch.no_grad()
def match_objects(
    scenes: DecodedScenes,
    boxes_2d: Boxes2D,
    views: SceneViews,
    box_weight: float = 5.0,
    occlusion_slack: float = 1.0,
) -> Matches:
    """Find the cheapest one-to-one assignment of predictions to tracked objects.

        sigma = argmin sum_k L^l + lambda_B L^B                       (Eq. S2)
        L^l = -p_k(l_j),    L^B = 1/|T_j| sum_p |b_k^p - b_j^p|_1     (Eq. S3)

    with 2D boxes b relative to the image size. In a room with n tracked objects, only the first n
    predictions take part. An object that is visible in no sampled view has zero cost: its match is
    arbitrary and enters no loss. `box_weight` is lambda_B; `occlusion_slack` is explained in
    `side_distance`.
    """
    cost = matching_cost(scenes, boxes_2d, views, box_weight, occlusion_slack)
    counts = views.object_counts
    if (most := max(counts)) > cost.shape[1]:
        raise ValueError(
            f"A room holds {most} tracked objects but the prior generates {cost.shape[1]}; set "
            f"model.max_objects to at least {most}."
        )
    return Matches(assign(cost, counts, counts), matchable(views))


def matchable(views: SceneViews) -> Bool[Tensor, "rooms objects"]:
    """`Matches.valid` of a batch."""
    return views.is_object & views.visible.any(dim=1)


def assign(
    cost: Float[Tensor, "rooms predictions objects"], predictions: list[int], objects: list[int]
) -> Int[Tensor, "rooms objects"]:
    """The prediction of each object in the one-to-one assignment of least total cost, room by room.

    In each room, the first `predictions[room]` rows and `objects[room]` columns of the cost take
    part, and `objects[room]` is at most `predictions[room]`. Padding gets 0.
    """
    from scipy.optimize import linear_sum_assignment  # takes half a second; training only

    prediction = np.zeros((len(cost), cost.shape[2]), dtype=np.int64)
    # SciPy rejects NaN. The loss will be NaN, too, and its check names the rooms.
    matrices = cost.detach().nan_to_num().cpu().numpy()
    for room, (count, many) in enumerate(zip(predictions, objects, strict=True)):
        rows, columns = linear_sum_assignment(matrices[room, :count, :many])
        prediction[room, columns] = rows
    return torch.from_numpy(prediction).to(cost.device)


def side_distance(
    predicted: Tensor, observed: Tensor, clear: Tensor, side: int, occlusion_slack: float
) -> Tensor:
    """Distance between one side of predicted 2D boxes and the same side of observed boxes.

    Args:
        predicted, observed: Coordinates of the side, relative to the image size.
        clear: True if the observed side is an edge of the object itself, not of an occluder. The
            three shapes broadcast.
        side: 0 to 3: left, upper, right, lower.
        occlusion_slack: Weight of the distance where the prediction extends beyond a side that is
            not clear. 1 uses the absolute difference everywhere (paper). Below 1, an object may
            extend behind an occluder, and views in which its own edge is visible determine its
            size. At 0, nothing would bound an object that touches another one in every view.
    """
    apart = predicted - observed
    distance = apart.abs()
    if occlusion_slack == 1:
        return distance
    beyond = apart < 0 if side < 2 else apart > 0
    return torch.where(beyond & ~clear, occlusion_slack * distance, distance)


def matching_cost(
    scenes: DecodedScenes,
    boxes_2d: Boxes2D,
    views: SceneViews,
    box_weight: float,
    occlusion_slack: float = 1.0,
) -> Float[Tensor, "rooms predictions objects"]:
    """Cost of each pair of prediction and tracked object: L^l + lambda_B L^B (Eq. S2)."""
    cost = class_cost(scenes, views.object_class)
    seen = views.visible.to(cost.dtype)
    distance = torch.zeros_like(cost)
    # One coordinate at a time takes a quarter of the memory of the full pairwise difference.
    for side in range(4):
        predicted = boxes_2d.boxes[..., side].unsqueeze(-1)
        target = views.boxes[..., side].unsqueeze(-2)
        clear = views.sides_clear[..., side].unsqueeze(-2)
        apart = side_distance(predicted, target, clear, side, occlusion_slack)
        distance += (apart * seen.unsqueeze(-2)).sum(dim=1)
    distance = distance / seen.sum(dim=1).clamp(min=1).unsqueeze(-2)
    cost = cost + box_weight * distance
    return cost * seen.any(dim=1).unsqueeze(-2)


def class_cost(
    scenes: DecodedScenes, object_class: Int[Tensor, "rooms objects"]
) -> Float[Tensor, "rooms predictions objects"]:
    """L^l of Eq. S3: minus the probability that each prediction has each object's class."""
    probability = scenes.class_logits.softmax(dim=-1)
    return -probability.gather(-1, object_class.unsqueeze(1).expand(-1, probability.shape[1], -1))

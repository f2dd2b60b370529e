"""The view loss (section 3.4): losses of layouts (Eq. 7 and S4), and of rendered masks (Eq. 8).

Completeness scores have two conventions, for a room of n objects:

- `first_n` (supplement B): 1 for the first n predictions, 0 after. A generated scene ends
  before its first prediction whose score is not above 0.5.
- `stop` (released code): 1 from the n-th prediction on, up to the count of the fullest room of the
  batch. A generated scene ends with its first prediction whose score is above 0.5; it is never
  empty.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch import distributed as dist
from torch.nn import functional as F

from sceneprior.core.cameras import Boxes2D, camera_centers, pixel_rays
from sceneprior.core.repeatable import constants
from sceneprior.core.views import DecodedScenes, SceneViews
from sceneprior.paper.matching import Matches, first_predictions, match_objects, side_distance
from sceneprior.paper.settings import LossConfig, ShapeConfig
from sceneprior.training.steps import check_finite, weighted_sum

CERTAIN = 1e-6
"""Pixels of a mask whose value is within this distance of 0 or 1 get no gradient."""


def take(values: Tensor, index: Int[Tensor, "rooms objects"], dim: int) -> Tensor:
    """Reorder predictions (axis `dim`; axis 0 is rooms) to the order of their matched objects."""
    shape = [1] * values.dim()
    shape[0], shape[dim] = index.shape
    return torch.take_along_dim(values, index.reshape(shape), dim)


def layout_losses(
    scenes: DecodedScenes,
    boxes_2d: Boxes2D,
    views: SceneViews,
    weights: LossConfig,
    completeness_target: str | None,
) -> tuple[dict[str, Float[Tensor, "*rooms"]], Matches]:
    """The four terms of the layout loss (Eq. 7), unweighted, and the matches that they compare.

        L_L = lambda_l L_l + lambda_box L_box + lambda_p L_p + lambda_f L_f

    Each term is averaged over the objects that it applies to, over the batches of all processes
    (`share_of_batch`). `boxes_2d` holds the predictions' boxes in the views; `completeness_target`
    is a convention of this module. None is for rooms that are fitted: each room has its own losses,
    without completeness, since a single image does not show how many objects the room holds
    (supplement D).

    Raises:
        FloatingPointError: the weighted sum is not finite. This is checked before anything is
            rendered, since the renderer's own error for vertices that are not finite names no room.
    """
    matches = match_objects(scenes, boxes_2d, views, weights.match_box, weights.occlusion_slack)
    losses = matched_losses(scenes, boxes_2d, views, matches, weights, completeness_target)
    check_finite(weighted_sum(losses, weights).detach().sum(), views.room_ids)
    return losses, matches


def matched_losses(
    scenes: DecodedScenes,
    boxes_2d: Boxes2D,
    views: SceneViews,
    matches: Matches,
    weights: LossConfig,
    completeness_target: str | None,
) -> dict[str, Float[Tensor, "*rooms"]]:
    """The terms of `layout_losses`, which documents the arguments, without its check."""
    slack, per_room = weights.occlusion_slack, completeness_target is None
    predicted = take(boxes_2d.boxes, matches.prediction, dim=2)
    inside = take(boxes_2d.in_frustum, matches.prediction, dim=2)
    centers = take(scenes.centers_m, matches.prediction, dim=1)
    seen = views.visible & matches.valid.unsqueeze(1)
    apart = (predicted, views.boxes, views.sides_clear, seen & inside)
    losses = {
        "class": class_loss(scenes, views.object_class, matches, per_room),
        "box": box_loss(*apart, slack, per_room),
    }
    if completeness_target is not None:
        losses["completeness"] = completeness_loss(scenes, views, completeness_target)
    losses["frustum"] = frustum_loss(centers, views, seen & ~inside, per_room)
    return losses


def class_loss(
    scenes: DecodedScenes,
    object_class: Int[Tensor, "rooms objects"],
    matches: Matches,
    per_room: bool = False,
) -> Float[Tensor, "*rooms"]:
    """L_l of Eq. 7: cross entropy between each object's class and its matched prediction."""
    logits = take(scenes.class_logits, matches.prediction, dim=1)
    each = F.cross_entropy(logits.flatten(0, 1), object_class.flatten(), reduction="none")
    return mean_of_objects(each.unflatten(0, logits.shape[:2]), matches.valid, per_room)


def box_loss(
    predicted: Float[Tensor, "rooms views objects 4"],
    target: Float[Tensor, "rooms views objects 4"],
    clear: Bool[Tensor, "rooms views objects 4"],
    counted: Bool[Tensor, "rooms views objects"],
    occlusion_slack: float,
    per_room: bool = False,
) -> Float[Tensor, "*rooms"]:
    """L_box of Eq. 7: L1 distance of 2D boxes (`side_distance`, summed over the four sides),
    averaged over visible views, then over objects."""
    apart = [
        side_distance(predicted[..., i], target[..., i], clear[..., i], i, occlusion_slack)
        for i in range(4)
    ]
    return _mean_of_views(torch.stack(apart).sum(dim=0), counted, per_room)


def completeness_loss(scenes: DecodedScenes, views: SceneViews, target: str) -> Float[Tensor, ""]:
    """L_p of Eq. 7: binary cross entropy of all completeness scores. `target` is the convention of
    their targets (`completeness_targets`)."""
    logits, counts = scenes.completeness_logits, views.is_object.sum(dim=-1)
    wanted = completeness_targets(counts, logits.shape[1], target).to(logits.dtype)
    # Rooms that `SceneViews.padded` adds do not count.
    real = (views.room_index >= 0).to(logits.dtype).unsqueeze(1)
    if target == "stop":
        position = torch.arange(logits.shape[1], device=logits.device)
        real = real * (position < counts.max())
    mean = F.binary_cross_entropy_with_logits(logits, wanted, real / real.mean())
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
    size = constants(views.boxes, width, height)
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


def seen_masks(
    vertices_m: Float[Tensor, "rooms objects vertices 3"],
    faces: Int[Tensor, "faces 3"],
    views: SceneViews,
    settings: ShapeConfig,
) -> Float[Tensor, "rooms views objects height width"]:
    """Soft visible masks of decoded objects, at the size of the views' instance ids.

    In a room of n objects, only the first n predictions, which are matched, are rendered; the
    others would occlude them.
    """
    from sceneprior.render.silhouettes.render import render_silhouettes  # not for new rooms

    height, width = views.observed_ids.shape[-2:]
    return render_silhouettes(
        vertices_m,
        faces,
        views.world_to_camera,
        views.mask_intrinsics(),
        (height, width),
        sigma_px2=settings.sigma_px2,
        mode=settings.silhouettes,
        compositing=settings.compositing,
        drawn=first_predictions(views, vertices_m.shape[1]),
    )


def mask_loss(
    rendered: Float[Tensor, "rooms views predictions height width"],
    views: SceneViews,
    matches: Matches,
    iou_gate: float,
    per_room: bool = False,
    passing_only: bool = False,
) -> tuple[Float[Tensor, "*rooms"], dict[str, Float[Tensor, "*rooms"]]]:
    """Binary cross entropy of visible masks whose IoU with the observation is high enough (Eq. 8).

        L_S = 1/|T_j| sum_(p in T_j) BCE(r_k^p, m_j^p) [IoU(r_k^p, m_j^p) > iou_gate]

    for each object j and its matched prediction k. The paper sums over views, with a gate of 0.5;
    here the loss is averaged over pixels, then over an object's views, then over objects.

    A mask whose IoU with its observation is not above `iou_gate` counts as zero, as in the paper;
    with `passing_only`, the loss is the mean over the pairs above it, as in the released code.
    Void pixels are left out of BCE and IoU, since the object may or may not extend there.

    `rendered` holds the visible soft masks of all predictions, at the size of the views' instance
    ids; `per_room` is explained in `mean_of_objects`.

    Returns:
        The loss, and, for logging, `mask_iou` (mean over all visible pairs) and `mask_used` (share
        of pairs that pass the gate); with `per_room`, one of each per room.
    """
    room, view, item = views.seen_places
    prediction = matches.prediction[room, item]
    known = views.known_pixels[room, view].to(rendered.dtype)
    mine = rendered[room, view, prediction] * known
    observed = (views.observed_ids[room, view] == (item + 1)[:, None, None]).to(mine.dtype)
    iou = soft_iou(mine.detach(), observed)
    use = (iou > iou_gate).to(mine.dtype)
    # For a wrong pixel that rounds to 0 or 1, torch's gradient of the logarithm would be 1e12.
    certain = mine.clamp(CERTAIN, 1 - CERTAIN)
    each = F.binary_cross_entropy(certain, observed, known, reduction="none").mean(dim=(1, 2))
    count = (views.visible & matches.valid.unsqueeze(1)).sum(dim=1)
    share = 1 / count[room, item].to(mine.dtype)
    per_object = mine.new_zeros(count.shape)
    per_object = per_object.index_put((room, item), each * use * share, accumulate=True)
    loss = mean_of_objects(per_object, count > 0, per_room)
    if passing_only:
        loss = mean_of_objects(each.unsqueeze(0), (iou > iou_gate).unsqueeze(0))
    if per_room:
        pairs = count.sum(dim=1).clamp(min=1)
        ious, used = (mine.new_zeros(len(count)).index_add(0, room, v) / pairs for v in (iou, use))
    else:
        ious, used = iou.sum() / max(len(room), 1), use.sum() / max(len(room), 1)
    return loss, {"mask_iou": ious, "mask_used": used}


def soft_iou(
    a: Float[Tensor, "pairs height width"], b: Float[Tensor, "pairs height width"]
) -> Float[Tensor, " pairs"]:
    """Intersection over union of soft masks; 0 if both are empty."""
    both = (a * b).sum(dim=(1, 2))
    return both / (a.sum(dim=(1, 2)) + b.sum(dim=(1, 2)) - both).clamp(min=1e-6)


def completeness_targets(
    counts: Int[Tensor, " rooms"], slots: int, convention: str
) -> Bool[Tensor, "rooms slots"]:
    """Target scores of `slots` predictions, in rooms of `counts` objects."""
    position = torch.arange(slots, device=counts.device)
    if convention == "stop":
        return position >= counts.unsqueeze(-1) - 1
    return position < counts.unsqueeze(-1)


def kept_objects(
    logits: Float[Tensor, "rooms slots"], convention: str
) -> Bool[Tensor, "rooms slots"]:
    """Mask of the predictions that belong to the scene; a logit above 0 is a score above 0.5."""
    says_yes = (logits > 0).long()
    if convention == "stop":
        return says_yes.cumsum(dim=-1) - says_yes == 0  # no earlier prediction said stop
    return says_yes.cumprod(dim=-1).bool()


def mean_of_objects(
    values: Float[Tensor, "rooms objects"],
    counted: Bool[Tensor, "rooms objects"],
    per_room: bool = False,
) -> Float[Tensor, "*rooms"]:
    """Mean over the objects for which `counted` is true; 0 if there are none.

    By default, one mean is taken over all objects of the batch, in all processes. With `per_room`,
    one mean is taken per room, independent of the rest of the batch; it is for rooms that are
    fitted separately.
    """
    weights = counted.to(values.dtype)
    if per_room:
        return (values * weights).sum(dim=1) / weights.sum(dim=1).clamp(min=1)
    count = weights.sum()
    return (values * weights).sum() / count.clamp(min=1) * share_of_batch(count)


def share_of_batch(count: Tensor) -> Float[Tensor, ""]:
    """Weight of this process's mean over `count` items in the mean over the items of all processes.

        share = processes * count / (sum of all processes' counts)

    DDP averages the gradients of all processes, and a mean of means is not the overall mean: an
    object in a process with few objects would count more. If each process multiplies its mean by
    its share, the averaged gradient equals that of a single process on the whole batch. The share
    is 1 for one process.

    Every process must call this function, in the same order, because it waits for the others.
    """
    mine = count.detach().to(torch.float32)
    if not (dist.is_available() and dist.is_initialized()):
        return torch.ones_like(mine)
    total = mine.clone()
    dist.all_reduce(total)
    return dist.get_world_size() * mine / total.clamp(min=1)

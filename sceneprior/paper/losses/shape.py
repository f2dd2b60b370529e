"""The mask loss of matched objects, L_S (section 3.4, Eq. 8)."""

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from sceneprior.core.views import SceneViews
from sceneprior.paper.losses.averages import mean_of_objects
from sceneprior.paper.losses.matching import Matches

CERTAIN = 1e-6
"""Pixels of a mask whose value is within this distance of 0 or 1 get no gradient."""


def mask_loss(
    rendered: Float[Tensor, "rooms views predictions height width"],
    views: SceneViews,
    matches: Matches,
    iou_gate: float = 0.5,
    per_room: bool = False,
) -> tuple[Float[Tensor, "*rooms"], dict[str, Float[Tensor, "*rooms"]]]:
    """Binary cross entropy of visible masks whose IoU with the observation is high enough (Eq. 8).

        L_S = 1/|T_j| sum_(p in T_j) BCE(r_k^p, m_j^p) [IoU(r_k^p, m_j^p) > iou_gate]

    for each object j and its matched prediction k. The paper sums over views, with a gate of 0.5;
    here the loss is averaged over pixels, then over an object's views, then over objects.

    A mask whose IoU with its observation is not above `iou_gate` counts as zero, as in the paper.
    Void pixels are left out of BCE and IoU, since the object may or may not extend there.

    `rendered` holds the visible soft masks of all predictions, at the size of the views' instance
    ids; `per_room` is explained in `mean_of_objects`.

    Returns:
        The loss, and, for logging, `mask_iou` (mean over all visible pairs) and `mask_used` (share
        of pairs that pass the gate); with `per_room`, one of each per room.
    """
    seen = views.visible & matches.valid.unsqueeze(1)
    room, view, item = seen.nonzero(as_tuple=True)
    prediction = matches.prediction[room, item]
    known = views.known_pixels[room, view].to(rendered.dtype)
    mine = rendered[room, view, prediction] * known
    observed = (views.observed_ids[room, view] == (item + 1)[:, None, None]).to(mine.dtype)
    iou = soft_iou(mine.detach(), observed)
    use = (iou > iou_gate).to(mine.dtype)
    # For a wrong pixel that rounds to 0 or 1, torch's gradient of the logarithm would be 1e12.
    certain = mine.clamp(CERTAIN, 1 - CERTAIN)
    each = F.binary_cross_entropy(certain, observed, known, reduction="none").mean(dim=(1, 2))
    count = seen.sum(dim=1)
    share = 1 / count[room, item].to(mine.dtype)
    per_object = mine.new_zeros(count.shape)
    per_object = per_object.index_put((room, item), each * use * share, accumulate=True)
    loss = mean_of_objects(per_object, count > 0, per_room)
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
